"""The study of the paper as one value: trainings, evaluations, and what was published beside them.

::

    study = Study(tasks=("pushing",), algos=("ppo",), seeds=(0,), scale=0.01)
    print(planned(study, "pushing-1-percent"))
    reproduce(study, "pushing-1-percent")
"""

from scm_world.training.study.cells import Cell, Study
from scm_world.training.study.costs import Plan, planned
from scm_world.training.study.holding import Reproduction, reproduce
from scm_world.training.study.published import FIGURES, Published, published
from scm_world.training.study.runs import Outcome

__all__ = [
    "FIGURES",
    "Cell",
    "Outcome",
    "Plan",
    "Published",
    "Reproduction",
    "Study",
    "planned",
    "published",
    "reproduce",
]
