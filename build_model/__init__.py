"""Builds a model from a scene: NN_F by construction, NN_e by training, one ONNX file with both.

Read in the order of the paper's argument: `runway_network` (NN_r), `reachability` (Prop. 2), `partition`, `enclosure`,
`spatial_filter` (S), `hough_bank` (entries, K and O), `filter_network` (NN_F), `filter_graph`, `state_network` (NN_e), `export`.
"""
