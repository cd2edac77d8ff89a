"""The proof of a model file: what is claimed in it, from the file's own tensors, in arithmetic that the build does not share."""
