"""Switch that turns off the telemetry of libraries."""

import os

# Each library reads its environment variable when it is imported or soon after. Calling
# onnxruntime.disable_telemetry_events() is not enough, because ONNX Runtime 1.31 sends telemetry even
# after that call.
_SWITCHES = {
    "ORT_DISABLE_TELEMETRY": "1",
    "GRADIO_ANALYTICS_ENABLED": "False",
    "RAY_USAGE_STATS_ENABLED": "0",
}


def disable_telemetry() -> None:
    """Turn off the telemetry of ONNX Runtime, Gradio and Ray in this process and its children.

    An environment variable that the user has set keeps its value.
    """
    for name, value in _SWITCHES.items():
        os.environ.setdefault(name, value)
