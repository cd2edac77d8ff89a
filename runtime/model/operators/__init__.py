"""The subset of the ONNX standard that a model may be written in, and the types and shapes of all that a graph computes.

By induction over the nodes, in their order, an operator's rule gives the type and shape of each tensor from those of the graph's inputs
and constants, before anything is run. A graph is refused where an attribute or a shape does not fit its operator, where a tensor would
be empty, where integers are divided by what could trap, and where the whole is larger than the limits of `graph`.
"""
