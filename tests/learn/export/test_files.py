import shutil
from pathlib import Path

import onnx
import pytest

from stereoweave.cli import root as cli
from stereoweave.learn.export import files as matcher_files
from stereoweave.learn.export import float16 as halve
from stereoweave.learn.export import int8 as quantise
from stereoweave.matching.matcher import model_file


def test_variants_are_made_from_a_shipped_network(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(halve, "_PROOF_PAIRS", 1)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["export", "small", "-o", "any.onnx"]) == 0
    assert cli.main(["export", "any.onnx", "-o", "all.onnx", "--half", "half.onnx", "--size", "96x64"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[:2] == ["any.onnx: float32", "all.onnx: float32"]
    assert told[2].startswith("half.onnx: 16 bits change disparity by 0.0")
    assert told[3:] == [f"{name}.onnx: only for pairs of 96x64" for name in ("all", "half")]
    for name in ("all", "half"):
        sides = onnx.load(f"{name}.onnx").graph.input[0].type.tensor_type.shape.dim
        assert [side.dim_value for side in sides] == [1, 3, 64, 96]
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        f"{name}.{ending}" for name in ("all", "any", "half") for ending in ("json", "onnx")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("export small", "expected an output file, found none"),
        ("export small -o out.trt", "out.trt: expected the file extension .onnx, found .trt"),
        ("export small -o a.onnx --half a.onnx", "a.onnx: expected a different file"),
        ("export small -o a.onnx --size 640", "such as 640x480, found '640'"),
        (
            "export small -o a.onnx --size 641x480",
            "expected multiples of 32 that are at least 32, found 641x480",
        ),
        ("export none.onnx -o a.onnx", "none.onnx: expected an ONNX matcher file, found no such file"),
        ("export none -o a.onnx", "none"),
        ("export small -o a.onnx --half folder.onnx", "folder.onnx: expected a writable file"),
    ],
)
def test_an_impossible_export_is_reported_in_one_line(tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.onnx").mkdir()
    assert cli.main(arguments.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert [file.name for file in tmp_path.iterdir()] == ["folder.onnx"]


def test_an_8_bit_file_is_requested_in_the_same_way(tmp_path, monkeypatch):
    taken = []
    monkeypatch.setattr(
        matcher_files,
        "quantise",
        lambda *files: taken.append(files) or {"epe_px": 1.25, "epe_px_of_32_bits": 1.5},
    )
    files = matcher_files.MatcherFiles(eight_bits=tmp_path / "small8.onnx")
    (line,) = matcher_files.write_matcher_files("small", files)
    assert line.endswith("small8.onnx: 8 bits change the mean error by -0.250 px")
    assert [out for _, out in taken] == [tmp_path / "small8.onnx"]
    assert quantise.LARGEST_LOSS_PX > 0


@pytest.mark.parametrize("option", ["-o", "--half", "--eight-bits"])
def test_an_export_does_not_overwrite_its_source(tmp_path, monkeypatch, capsys, option):
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(model_file("small"), "mine.onnx")
    assert cli.main(["export", "mine.onnx", option, str(tmp_path / "mine.onnx")]) == 2
    assert (
        "mine.onnx: expected an output file other than the source, found the source itself"
        in capsys.readouterr().err
    )
    assert Path("mine.onnx").read_bytes() == model_file("small").read_bytes()
