"""Refinement: sets of states that passed the bank are contracted to what the frame can tell."""

from runtime.refine.refiner import LARGEST_START, Refiner, joined
from runtime.refine.regions import MOST_TO_JOIN, connected_parts

__all__ = ["LARGEST_START", "MOST_TO_JOIN", "Refiner", "connected_parts", "joined"]
