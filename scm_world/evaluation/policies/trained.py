"""Players of policies that were trained with this package."""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

from scm_world.env import ScmWorldEnv
from scm_world.errors import ActionError, UnreadableFile
from scm_world.evaluation.policies.cards import PolicyAbout, refuse_other_form
from scm_world.evaluation.policies.players import About, Actions, Player, Playing
from scm_world.evaluation.policies.weights import NetworkPolicy

BEST, LAST = "best.safetensors", "policy.safetensors"
"""What the folder of a training run has: the best in its evaluations, and the last one."""


@final
class ByWeights(Playing):
    """Asks a network of this package.

    Args:
        policy: The network.
        about: What it is.
    """

    def __init__(self, policy: NetworkPolicy, about: About) -> None:
        super().__init__(about)
        self._policy = policy

    @property
    def made_for(self) -> PolicyAbout:
        """What the policy was trained for."""
        return self._policy.about

    @property
    def is_plain(self) -> bool:
        """Whether its actions follow from what it observes: they do."""
        return True

    def twin(self) -> Player:
        """Give itself: it remembers nothing."""
        return self

    def begin(self, env: ScmWorldEnv) -> None:
        """Check that the environment is like the one that the policy was trained in.

        Raises:
            UnknownOption: Its options are others.
            ActionError: It shows or takes more or fewer numbers, as another task does.
        """
        refuse_other_form(self.made_for, env, self._name)
        self._policy.joined(env.observe())
        if (self._policy.n_actions,) != env.action_space.shape:
            given, taken = self._policy.n_actions, env.world.declaration.n_actions
            raise ActionError(f"the policy gives {given} numbers, and an action has {taken}", None)
        self._env = env

    def act(self, observation: Any) -> Actions:
        """Choose an action, shape (n_actions,)."""
        return self._checked(self._policy(observation))


def in_run(folder: Path) -> Path:
    """Find the policy of a training run: the best one if there is one, else the last one.

    Args:
        folder: Of the run.

    Raises:
        UnreadableFile: There is none.
    """
    for name in (BEST, LAST):
        if (folder / name).is_file():
            return folder / name
    advice = "give the folder of a training run that has begun to evaluate, or a file"
    raise UnreadableFile(str(folder), f"it has neither {BEST} nor {LAST}", advice)
