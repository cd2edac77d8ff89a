"""Refinement: sets of states that passed the bank are contracted to what the frame can tell."""

from runtime.refine.refiner import LARGEST_START, MOST_TO_JOIN, Refiner, connected_parts, joined

__all__ = ["LARGEST_START", "MOST_TO_JOIN", "Refiner", "connected_parts", "joined"]
