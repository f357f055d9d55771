"""Figures, drawn with matplotlib from plain arrays: arrays in, figure out, and `save` writes it."""

from adapters.figures.comparison import Compared, comparison
from adapters.figures.convergence import convergence
from adapters.figures.files import save
from adapters.figures.internal_dynamics import Watch, internal_dynamics
from adapters.figures.learning_curve import learning_curve
from adapters.figures.q_heatmaps import Panel, q_heatmaps

__all__ = [
    "Compared",
    "Panel",
    "Watch",
    "comparison",
    "convergence",
    "internal_dynamics",
    "learning_curve",
    "q_heatmaps",
    "save",
]
