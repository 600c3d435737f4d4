"""Trained policies that come with this package, each with a card.

A policy of the zoo is named ``"zoo:pushing"`` wherever a policy is named::

    evaluate("zoo:pushing", "P0,P5")
    print(card_text(card("zoo:pushing")))
"""

from __future__ import annotations

from collections.abc import Mapping

from scm_world.evaluation.policies.cards import PolicyAbout
from scm_world.evaluation.policies.weights import load_policy
from scm_world.evaluation.zoo.shelf import names, path_of
from scm_world.evaluation.zoo.texts import card_text, page_text


def card(name: str) -> PolicyAbout:
    """Give what a policy of the zoo says of itself.

    Args:
        name: ``"zoo:pushing"``, or ``"pushing"``.

    Raises:
        UnknownOption: There is none of this name.
    """
    return load_policy(path_of(name)).about


def zoo() -> Mapping[str, PolicyAbout]:
    """List all policies of the zoo, and what they say of themselves."""
    return {name: card(name) for name in names()}


def page() -> str:
    """Write the cards of all policies as one page in Markdown."""
    return page_text(zoo())


__all__ = ["card", "card_text", "page", "zoo"]
