"""What people look at: pictures, a page and videos of an evaluation."""

from scm_world.evaluation.outputs.bars import draw_bars
from scm_world.evaluation.outputs.causes import draw_causes
from scm_world.evaluation.outputs.gap import draw_gap
from scm_world.evaluation.outputs.profiles import draw_profile
from scm_world.evaluation.outputs.radar import draw_radar
from scm_world.evaluation.outputs.report import write_report
from scm_world.evaluation.outputs.videos import record_videos

__all__ = [
    "draw_bars",
    "draw_causes",
    "draw_gap",
    "draw_profile",
    "draw_radar",
    "record_videos",
    "write_report",
]
