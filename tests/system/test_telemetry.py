"""The usage reports of libraries are turned off before any of the libraries is imported."""

import json
import os
import subprocess
import sys

OFF = {"ORT_DISABLE_TELEMETRY": "1", "GRADIO_ANALYTICS_ENABLED": "False", "RAY_USAGE_STATS_ENABLED": "0"}


def variables_after(program: str, **chosen: str) -> dict[str, str]:
    """Run a program with only the chosen variables set, and return the three variables at its end."""
    others = {name: value for name, value in os.environ.items() if name not in OFF}
    program += f"; import json, os; print(json.dumps([os.environ.get(name) for name in {list(OFF)}]))"
    done = subprocess.run(
        [sys.executable, "-c", program], env=others | chosen, capture_output=True, text=True, check=True
    )
    return dict(zip(OFF, json.loads(done.stdout), strict=True))


def test_importing_a_module_of_the_package_turns_off_all_reports():
    assert variables_after("import stereoweave.system.threads") == OFF


def test_variables_that_the_user_has_set_are_kept():
    chosen = {
        "ORT_DISABLE_TELEMETRY": "0",
        "GRADIO_ANALYTICS_ENABLED": "True",
        "RAY_USAGE_STATS_ENABLED": "1",
    }
    assert variables_after("import stereoweave", **chosen) == chosen
