"""What driving has shown about places: how long they take, and how often moves fail there."""

from ddqn_planner.experience.experience import (
    ExpectedTime,
    Experience,
    ExperienceFileError,
    Learned,
)
