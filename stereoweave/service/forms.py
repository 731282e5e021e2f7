"""Forms for requests to the service: their fields, their validation, and the storage of their files."""

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


def _check_range(text: str | None) -> str | None:
    if text is not None and not re.fullmatch(_RANGE, text):
        raise ValueError(
            f"expected the least and the greatest disparity, such as -20,150, found {text[:40]!r}"
        )
    return text


class PairForm(BaseModel):
    """Fields of every request."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    left: Annotated[UploadFile | None, Field(description="Left picture.")] = None
    right: Annotated[UploadFile | None, Field(description="Right picture, of the same size.")] = None
    picture: Annotated[
        UploadFile | None, Field(description="One picture with both views, instead of left and right.")
    ] = None
    format: Annotated[
        Literal[FORMATS] | None,  # type: ignore[valid-type]
        Field(description="Layout of `picture` (default: detected)."),
    ] = None
    calib: Annotated[
        UploadFile | None,
        Field(description="Calibration file: OpenCV, Kalibr, KITTI or Middlebury format."),
    ] = None
    focal_px: Annotated[
        PositiveFloat | None, Field(description="Focal length in pixels, if there is no calibration file.")
    ] = None
    baseline_m: Annotated[
        PositiveFloat | None,
        Field(description="Distance between the cameras in metres, if there is no calibration file."),
    ] = None
    rectify: Annotated[bool, Field(description="Rectify the pair first.")] = False
    range: Annotated[
        str | None,
        AfterValidator(_check_range),
        Field(
            description="Least and greatest disparity in pixels, such as 0,96 (default: estimated).",
            json_schema_extra={"pattern": _RANGE},
        ),
    ] = None
    check: Annotated[bool, Field(description="Check the pair and report its problems in the notes.")] = False

    def uploads(self) -> dict[str, datastructures.UploadFile]:
        """Return the uploaded pictures by field name: left and right, or picture alone."""
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

    def job_arguments(self, calibration: Path | None) -> dict[str, Any]:
        """Return the arguments of `ServiceJob` that the form's fields determine."""
        request = Request(
            format=self.format,
            calibration=calibration,
            focal_px=self.focal_px,
            baseline_m=self.baseline_m,
            rectify=self.rectify,
        )
        return {"request": request, "options": self.options(), "checked": self.check}

    def options(self) -> MatchOptions:
        """Return the form's matching options."""
        return MatchOptions(range_px=self._range_px())

    def _range_px(self) -> tuple[float, float] | None:
        if self.range is None:
            return None
        low_px, high_px = map(float, self.range.split(","))
        return low_px, high_px


class MapForm(PairForm):
    """Fields of a request for disparity or depth."""

    refined: Annotated[
        bool,
        Field(description="Match once more wherever the network is not certain; base and best always do."),
    ] = False
    file: Annotated[
        Literal["png", "pfm", "npy", "tiff"],
        Field(description="png: 16 bits, px * 256 or millimetres; the others: float32."),
    ] = "png"

    def options(self) -> MatchOptions:
        """Return the form's matching options, including refinement."""
        return replace(super().options(), refined=self.refined)


class ViewForm(PairForm):
    """Fields of a request for a view."""

    position: Annotated[
        FiniteFloat, Field(ge=-1, le=2, description="Viewpoint: 0 is the left camera and 1 the right one.")
    ] = 0.5
    strength: Annotated[
        NonNegativeFloat,
        Field(description="Factor by which the baseline is multiplied about its midpoint."),
    ] = 1.0
    file: Annotated[Literal["png", "jpg"], Field(description="File format.")] = "png"

    def job_arguments(self, calibration: Path | None) -> dict[str, Any]:
        """Return the arguments of `ServiceJob` that the form's fields determine, including the viewpoint."""
        return super().job_arguments(calibration) | {"position": self.position, "strength": self.strength}


def store_uploads(form: PairForm, folder: Path, file: str, most_megapixels: float) -> ServiceJob:
    """Store a form's files in a folder, each under its field's name, and return the form's job."""
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
        **form.job_arguments(calibration),
    )
