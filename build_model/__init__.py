"""Builds a model from a scene: NN_F by construction, NN_e by training, one ONNX file with both.

Read in the order of the argument: `partition`, `enclosure`, `spatial_filter` (S), `hough_bank` (entries, K and O), `filter_network` (NN_F
as it is defined), `run_table`, `assembly` and `filter_graph` (NN_F as it is deployed), `state_network` (NN_e), `export`. The paper's own
formulas are in `build_model.paper`, the proof of a file in `build_model.verify`.
"""
