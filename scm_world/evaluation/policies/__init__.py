"""Who acts in an evaluation: anything that chooses actions, read as a player."""

from scm_world.evaluation.policies.cards import PolicyAbout
from scm_world.evaluation.policies.players import Player, WorldPolicy, checked
from scm_world.evaluation.policies.reading import NAMES, as_player, player_from
from scm_world.evaluation.policies.weights import NetworkPolicy, load_policy, save_policy

__all__ = [
    "NAMES",
    "NetworkPolicy",
    "Player",
    "PolicyAbout",
    "WorldPolicy",
    "as_player",
    "checked",
    "load_policy",
    "player_from",
    "save_policy",
]
