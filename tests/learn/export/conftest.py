from collections.abc import Callable
from typing import Any

import pytest
import torch
from tracing import without_tracer


@pytest.fixture(autouse=True)
def untraced_exporter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run PyTorch's exporter without the tracer; it is Python, and the networks have tests of their own."""
    export: Callable[..., Any] = torch.onnx.export

    def export_untraced(*arguments: Any, **options: Any) -> Any:
        with without_tracer():
            return export(*arguments, **options)

    monkeypatch.setattr(torch.onnx, "export", export_untraced)
