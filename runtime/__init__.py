"""Certified vision-based state estimation of landing aircraft: the embedded runtime. Needs numpy and onnxruntime only.

    estimator = Estimator.load()
    estimate = estimator.estimate(frame)

Conventions: `runtime.camera`. What is guaranteed: `runtime.estimator` and docs/guarantee.md.
"""

from runtime import offline  # noqa: F401  first
from runtime.attitude import Attitude
from runtime.estimate import Box, Estimate, FrameError, Outcome
from runtime.estimator import Estimator
from runtime.frames import EventError, FrameStream, events_to_frames
from runtime.model.format import ModelError
from runtime.motion import Motion
from runtime.scene import Scene, SceneError
from runtime.tracker import Tracker

__all__ = [
    "Attitude",
    "Box",
    "Estimate",
    "Estimator",
    "EventError",
    "FrameError",
    "FrameStream",
    "ModelError",
    "Motion",
    "Outcome",
    "Scene",
    "SceneError",
    "Tracker",
    "events_to_frames",
]
