"""Who acts in an evaluation: anything that chooses actions, read as a player."""

from scm_world.evaluation.policies.players import Player, WorldPolicy, checked
from scm_world.evaluation.policies.reading import NAMES, as_player, player_from

__all__ = ["NAMES", "Player", "WorldPolicy", "as_player", "checked", "player_from"]
