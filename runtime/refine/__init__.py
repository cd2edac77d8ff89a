"""Refinement: sets of states that passed the bank are contracted to what the frame can tell."""
