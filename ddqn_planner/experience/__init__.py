"""What driving has shown of places: how long they take, and how often moves fail."""

from ddqn_planner.experience.experience import (
    ExpectedTime,
    Experience,
    ExperienceFileError,
    Learned,
)
