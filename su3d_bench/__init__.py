"""Evaluation and benchmarking of open-vocabulary, instance-level 3D scene understanding from RGB-D."""

import os

__version__ = "0.1.0"

# ONNX Runtime from 1.29 on tells its makers of every session and keeps an identity of the machine in the user's cache;
# it looks at this once, when it is loaded (microsoft/onnxruntime, pull request 27379). Who wants that sets 0.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
