"""Episodes of environments, recorded with all that it takes to live through them again."""

from scm_world.evaluation.recording.episodes import Recorded
from scm_world.evaluation.recording.recorder import Recorder, record
from scm_world.evaluation.recording.recording import Recording

__all__ = ["Recorded", "Recorder", "Recording", "record"]
