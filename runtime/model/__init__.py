"""A model file's bytes, checked before onnxruntime sees them: what a model may hold, its entries, and the session that runs it."""
