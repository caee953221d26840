"""Plans to look at: as text, as a picture and as an animation. No ROS is needed."""

from ddqn_planner.pictures.animation import save_animation
from ddqn_planner.pictures.picture import (
    MAX_TEXT_WIDTH,
    PictureError,
    draw_blocks,
    draw_text,
    save_picture,
)

__all__ = [
    "MAX_TEXT_WIDTH",
    "PictureError",
    "draw_blocks",
    "draw_text",
    "save_animation",
    "save_picture",
]
