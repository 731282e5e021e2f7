"""The one place that turns off what libraries would send to their makers."""

import os

# Each library reads its variable when it is imported or soon after. onnxruntime.disable_telemetry_events() is
# no substitute: the reports of 1.31 go on after it.
_SWITCHES = {
    "ORT_DISABLE_TELEMETRY": "1",
    "GRADIO_ANALYTICS_ENABLED": "False",
    "RAY_USAGE_STATS_ENABLED": "0",
}


def disable_telemetry() -> None:
    """Turn off the reports of ONNX Runtime, Gradio and Ray, here and in child processes.

    A variable that the user has set keeps its value.
    """
    for name, value in _SWITCHES.items():
        os.environ.setdefault(name, value)
