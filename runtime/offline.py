"""Keeps onnxruntime from recording its use in the user's home; imported before onnxruntime is.

onnxruntime's newer wheels for Linux record their use in a data base in the user's home, for Microsoft, and warn on stderr where that
cannot be written. They look at one of these variables, which one depends on the version, when they are first imported; a user's own
value stands.
"""

import os

for variable in ("ORT_DISABLE_TELEMETRY", "ORT_TELEMETRY_DISABLED"):
    os.environ.setdefault(variable, "1")
