"""What people look at: figures, a page and videos of an evaluation."""

from scm_world.evaluation.outputs.figures import (
    bars_figure,
    causes_figure,
    gap_figure,
    profile_figure,
    radar_figure,
)
from scm_world.evaluation.outputs.report import write_outputs, write_report
from scm_world.evaluation.outputs.videos import record_videos
from scm_world.output.canvas import save

__all__ = [
    "bars_figure",
    "causes_figure",
    "gap_figure",
    "profile_figure",
    "radar_figure",
    "record_videos",
    "save",
    "write_outputs",
    "write_report",
]
