"""What a request of the service says, as the fields of a form, and its files put where they are worked on."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import HTTPException, UploadFile
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeFloat,
    PositiveFloat,
)
from starlette import datastructures

from stereoweave.io.files import MOST_SMALL_BYTES
from stereoweave.matching.options import MatchOptions
from stereoweave.pictures.loading import FORMATS
from stereoweave.pictures.prepare import Request
from stereoweave.service.answers import ServiceJob, TooLargeError

_RANGE = r"^-?\d{1,6}(\.\d{1,6})?,-?\d{1,6}(\.\d{1,6})?$"


def _checked_range(text: str | None) -> str | None:
    if text is not None and not re.fullmatch(_RANGE, text):
        raise ValueError(
            f"expected the least and the greatest disparity, such as -20,150, found {text[:40]!r}"
        )
    return text


class PairForm(BaseModel):
    """What every request says."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    left: Annotated[UploadFile | None, Field(description="The left picture.")] = None
    right: Annotated[UploadFile | None, Field(description="The right one, of the same size.")] = None
    picture: Annotated[UploadFile | None, Field(description="Instead, one that holds both views.")] = None
    format: Annotated[
        Literal[FORMATS] | None,  # type: ignore[valid-type]
        Field(description="How that one holds both views; guessed unless given."),
    ] = None
    calib: Annotated[
        UploadFile | None,
        Field(description="The cameras' calibration, of OpenCV, Kalibr, KITTI or Middlebury."),
    ] = None
    focal_px: Annotated[
        PositiveFloat | None, Field(description="Without a calibration, the focal length in pixels.")
    ] = None
    baseline_m: Annotated[
        PositiveFloat | None, Field(description="And the distance between the cameras in metres.")
    ] = None
    rectify: Annotated[bool, Field(description="Bring the rows of both to match first.")] = False
    range: Annotated[
        str | None,
        AfterValidator(_checked_range),
        Field(
            description="The least and the greatest disparity in pixels, such as 0,96; found unless given.",
            json_schema_extra={"pattern": _RANGE},
        ),
    ] = None
    check: Annotated[bool, Field(description="Also say in the notes what is amiss with the pair.")] = False

    def uploads(self) -> dict[str, datastructures.UploadFile]:
        """The pictures by their field: left and right, or the one of both views."""
        given = {"left": self.left, "right": self.right, "picture": self.picture}
        pictures: dict[str, datastructures.UploadFile] = {
            field: upload for field, upload in given.items() if upload is not None
        }
        if set(pictures) not in ({"left", "right"}, {"picture"}):
            raise HTTPException(
                422,
                f"expected the files left and right, or picture alone, found {', '.join(pictures) or 'none'}",
            )
        return pictures

    def said(self, calibration: Path | None) -> dict[str, Any]:
        """What a `ServiceJob` takes of it."""
        request = Request(
            arrangement=self.format,
            calibration=calibration,
            focal_px=self.focal_px,
            baseline_m=self.baseline_m,
            rectify=self.rectify,
        )
        return {"request": request, "options": self.options(), "checked": self.check}

    def options(self) -> MatchOptions:
        """How the pair is matched."""
        return MatchOptions(range_px=self._range_px())

    def _range_px(self) -> tuple[float, float] | None:
        if self.range is None:
            return None
        low_px, high_px = map(float, self.range.split(","))
        return low_px, high_px


class MapForm(PairForm):
    """What a request for disparity or depth says."""

    refined: Annotated[bool, Field(description="Match once more, at full resolution.")] = False
    file: Annotated[
        Literal["png", "pfm", "npy", "tiff"],
        Field(description="png is of 16 bits, px * 256 or millimetres; the others are of float32."),
    ] = "png"

    def options(self) -> MatchOptions:
        """As before, refined on request."""
        return replace(super().options(), refined=self.refined)


class ViewForm(PairForm):
    """What a request for a view says."""

    position: Annotated[
        FiniteFloat, Field(ge=-1, le=2, description="0 is the left camera, 1 the right one.")
    ] = 0.5
    strength: Annotated[
        NonNegativeFloat, Field(description="Multiplies the distance of the cameras, about their middle.")
    ] = 1.0
    file: Annotated[Literal["png", "jpg"], Field(description="The kind of picture.")] = "png"

    def said(self, calibration: Path | None) -> dict[str, Any]:
        """As before, and where it is seen from."""
        return super().said(calibration) | {"position": self.position, "strength": self.strength}


def stored(form: PairForm, folder: Path, file: str, most_megapixels: float) -> ServiceJob:
    """The job of a form, whose files now lie in the folder, under names that the service gives them."""
    uploads = form.uploads()
    for field, upload in uploads.items():
        with (folder / field).open("wb") as out:
            shutil.copyfileobj(upload.file, out)
    calibration = None
    if form.calib is not None:
        content = form.calib.file.read(MOST_SMALL_BYTES + 1)
        if len(content) > MOST_SMALL_BYTES:
            raise TooLargeError(f"calib: expected at most {MOST_SMALL_BYTES} bytes, found more")
        calibration = folder / "calib"
        calibration.write_bytes(content)
    pictures = tuple(folder / field for field in uploads)
    return ServiceJob(
        folder=folder,
        pictures=pictures,
        file=file,
        most_megapixels=most_megapixels,
        **form.said(calibration),
    )
