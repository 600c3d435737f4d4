"""Data from interventions: tables with regimes, and how to collect them."""

from scm_world.discovery.data.collect import collect, collect_parts
from scm_world.discovery.data.croissant import as_huggingface
from scm_world.discovery.data.dataset import Column, Dataset, Regime
from scm_world.discovery.data.designs import DESIGNS, Design
from scm_world.discovery.data.files import batches, load, save
from scm_world.discovery.data.pictures import Pictures, triplets
from scm_world.discovery.data.recorded import default_causes, default_outcomes
from scm_world.discovery.data.sweeps import Levels, Swept, sweep
from scm_world.discovery.data.truth import GroundTruth
from scm_world.discovery.data.views import (
    CausalLearn,
    as_causal_learn,
    as_dcdi,
    as_frame,
    as_gies,
    as_tigramite,
    from_frame,
)

__all__ = [
    "DESIGNS",
    "CausalLearn",
    "Column",
    "Dataset",
    "Design",
    "GroundTruth",
    "Levels",
    "Pictures",
    "Regime",
    "Swept",
    "as_causal_learn",
    "as_dcdi",
    "as_frame",
    "as_gies",
    "as_huggingface",
    "as_tigramite",
    "batches",
    "collect",
    "collect_parts",
    "default_causes",
    "default_outcomes",
    "from_frame",
    "load",
    "save",
    "sweep",
    "triplets",
]
