import base64

import numpy as np
import pytest
from PIL import Image
from vr180_examples import embed, encode_jpeg, make_extension, make_gpano, make_vr180

import stereoweave as sw
from experiments.sphere_windows.room import look_equirectangular, look_fisheye, render_fixed, render_turning
from stereoweave.cameras.alignment import check_pair
from stereoweave.cameras.spherical import SphereRequest
from stereoweave.errors import StereoweaveError
from stereoweave.pictures.loading import open_pictures
from stereoweave.pictures.prepare import Request, prepare


@pytest.fixture(scope="session")
def half_scene():
    return render_fixed(look_equirectangular((512, 512)))


@pytest.fixture(scope="session")
def round_scene():
    return render_turning((768, 384))


def save(path, *images, xmp=None):
    image = np.vstack(images) if len(images) == 2 else images[0]
    Image.fromarray(image).save(path, **({"xmp": xmp} if xmp else {}))
    return path


def refusal(*paths, **sphere):
    with pytest.raises(StereoweaveError) as error:
        open_pictures(paths, None, SphereRequest(**sphere))
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_vr180_photo_opens_as_a_window_straight_ahead(tmp_path, half_scene):
    path = tmp_path / "a.vr.jpg"
    path.write_bytes(make_vr180(half_scene.left, half_scene.right))
    opened = open_pictures([path])
    assert [note.text for note in opened.notes] == [
        "a VR180 photo, with the right eye in its metadata",
        "half_equirectangular of 180x180 degrees; shown: a window at 0,0 degrees, 326x326 px",
    ]
    found = check_pair(opened.pair.left, opened.pair.right)
    assert found.vertical_error_95_px < 0.5 and not found.defects


def test_the_right_eye_may_span_many_segments_in_any_order(tmp_path, half_scene):
    path = tmp_path / "a.vr.jpg"
    parts = make_extension(embed(encode_jpeg(half_scene.right)), most=5000)
    assert len(parts) > 10
    path.write_bytes(make_vr180(half_scene.left, half_scene.right, extension=parts[::-1]))
    whole = tmp_path / "b.vr.jpg"
    whole.write_bytes(make_vr180(half_scene.left, half_scene.right))
    np.testing.assert_array_equal(open_pictures([path]).pair.right, open_pictures([whole]).pair.right)


def test_elements_say_the_same_as_attributes(tmp_path, half_scene):
    path = tmp_path / "a.jpg"
    data = base64.b64encode(encode_jpeg(half_scene.right))
    text = b"<GImage:Mime>image/jpeg</GImage:Mime><GImage:Data>" + data + b"</GImage:Data>"
    gpano = make_gpano(512, 512).replace(
        b'GPano:FullPanoWidthPixels="1024"',
        b'a="b"><GPano:FullPanoWidthPixels>1024</GPano:FullPanoWidthPixels',
    )
    path.write_bytes(make_vr180(half_scene.left, None, gpano=gpano, extension=make_extension(text)))
    assert open_pictures([path]).sphere.projection.yaw_deg == (-90, 90)


def test_a_crop_of_the_sphere_shows_its_angles(tmp_path, half_scene):
    path = tmp_path / "a.jpg"
    # 128 of 512 rows at the top are cut off: 45 of 180 degrees.
    gpano = make_gpano(512, 512, CroppedAreaImageHeightPixels=384, CroppedAreaTopPixels=128)
    path.write_bytes(make_vr180(half_scene.left[128:], half_scene.right[128:], gpano=gpano))
    cropped = open_pictures([path])
    assert cropped.sphere.projection.pitch_deg == (-90, 45)
    path.write_bytes(make_vr180(half_scene.left, half_scene.right))
    error = np.abs(cropped.pair.left.astype(int) - open_pictures([path]).pair.left)
    assert error.mean() < 3


@pytest.mark.parametrize("layout", ["top_bottom", "side_by_side"])
def test_a_360_degree_pair_is_cut_in_any_direction(tmp_path, round_scene, layout):
    stack = np.vstack if layout == "top_bottom" else np.hstack
    path = save(tmp_path / "a.png", stack([round_scene.left, round_scene.right]))
    for look_deg in ((0, 0), (120, 15)):
        request = SphereRequest(projection="equirectangular", look_deg=look_deg, fov_deg=80)
        opened = open_pictures([path], layout, request)
        found = check_pair(opened.pair.left, opened.pair.right)
        assert found.vertical_error_95_px < 0.7 and not found.defects
        assert "on a cylinder" in opened.notes[-1].text


def test_a_name_states_the_projection_if_the_shape_fits(tmp_path, round_scene):
    images = round_scene.left, round_scene.right
    named = open_pictures([save(tmp_path / "room_360_TB.png", *images)])
    assert "equirectangular of 360x180 degrees, detected from the name" in named.notes[-1].text
    assert str(named.notes[-1]).endswith("; rectilinear is an ordinary picture (projection)")
    assert open_pictures([save(tmp_path / "room.png", *images)], "top_bottom").sphere is None
    ordinary = SphereRequest(projection="rectilinear")
    assert open_pictures([tmp_path / "room_360_TB.png"], "top_bottom", ordinary).sphere is None
    wide = [image[100:284] for image in images]
    assert open_pictures([save(tmp_path / "b_360_TB.png", *wide)], "top_bottom").sphere is None


def test_fisheye_circles_side_by_side_are_cut(tmp_path):
    scene = render_fixed(look_fisheye(400, 190.0))
    path = save(tmp_path / "a.png", np.hstack([scene.left, scene.right]))
    request = SphereRequest(projection="fisheye", lens_fov_deg=190)
    opened = open_pictures([path], "side_by_side", request)
    found = check_pair(opened.pair.left, opened.pair.right)
    assert found.vertical_error_95_px < 0.7 and not found.defects
    assert "fisheye of 190 degrees" in opened.notes[-1].text


def test_half_size_views_of_a_sphere_are_not_enlarged(tmp_path, round_scene):
    flat = [np.ascontiguousarray(image[::2]) for image in (round_scene.left, round_scene.right)]
    path = save(tmp_path / "a.png", *flat)
    request = SphereRequest(projection="equirectangular")
    for layout in ("top_bottom", "top_bottom_half"):
        opened = open_pictures([path], layout, request)
        assert opened.layout == "top_bottom" and opened.sphere.eye_size_px == (768, 192)


def test_a_window_has_metres_if_the_baseline_is_given(tmp_path, half_scene):
    path = tmp_path / "a.vr.jpg"
    path.write_bytes(make_vr180(half_scene.left, half_scene.right))
    assert prepare([path], Request()).pair.camera is None
    camera = prepare([path], Request(baseline_m=0.063)).pair.camera
    assert camera.focal_px == pytest.approx(512 / np.pi) and camera.baseline_m == 0.063
    aside = Request(baseline_m=0.063, sphere=SphereRequest(look_deg=(40, 0), fov_deg=60))
    # 40 degrees aside, of which the middle is at tan(40) + (tan(70) - tan(40)) / 2 and so on.
    prepared = prepare([path], aside)
    assert prepared.pair.camera.cx_px < 0
    with pytest.raises(StereoweaveError, match="and no focal length.*; omit them"):
        prepare([path], Request(focal_px=100.0, baseline_m=0.063))


def test_a_window_of_a_360_degree_picture_has_no_metres(tmp_path, round_scene):
    path = save(tmp_path / "a_360_tb.png", round_scene.left, round_scene.right)
    prepared = prepare([path], Request(baseline_m=0.065))
    assert prepared.pair.camera is None
    assert str(prepared.notes[-1]).startswith("no depth in metres: a window of a 360-degree picture")
    assert str(prepared.notes[-1]).endswith("; take the whole field of view for distances (whole)")


def test_estimate_takes_a_window_of_a_file_and_of_images(tmp_path, half_scene):
    path = tmp_path / "a.vr.jpg"
    path.write_bytes(make_vr180(half_scene.left, half_scene.right))
    by_file = sw.estimate(path, fov_deg=60)
    by_images = sw.estimate(half_scene.left, half_scene.right, projection="half_equirectangular", fov_deg=60)
    assert by_file.pair.left.shape == by_images.pair.left.shape == (188, 188, 3)
    # The wall ahead is 30 baselines away: 163 px of focal length / 30.
    middle = np.s_[80:108, 80:108]
    for found in (by_file, by_images):
        assert np.median(found.disparity_px[middle]) == pytest.approx(512 / np.pi / 30, abs=0.2)


DAMAGED = {
    "no right eye": ({"extension": []}, "found none; some programs drop it"),
    "a cut-off right eye": ({"stated_bytes": 10_000_000}, "expected 10000000 bytes of extended metadata"),
    "4 GB stated": ({"stated_bytes": 2**32 - 1}, "expected 4294967295 bytes of extended metadata"),
    "a missing segment": ({"drop": 1}, "without a gap; copy or export it again"),
    "no picture": ({"right": b"hello"}, "(right eye): expected a picture"),
    "half a picture": ({"cut": 2}, "(right eye): expected a picture"),
    "an empty right eye": ({"right": b""}, "found none; some programs drop it"),
    "one letter of base64": ({"text": b'<GImage:Data="A"'}, "found damaged text"),
    "another size": ({"smaller": 2}, "two pictures of the same size, found 512x512 and 256x256"),
    "a crop larger than all": ({"gpano": {"FullPanoWidthPixels": 100}}, "expected GPano metadata of a part"),
    "a width of zero": ({"gpano": {"CroppedAreaImageWidthPixels": 0}}, "expected GPano metadata of a part"),
    "a width in words": ({"gpano": {"FullPanoWidthPixels": "wide"}}, "FullPanoWidthPixels wide"),
    "a negative top": ({"gpano": {"CroppedAreaTopPixels": -5}}, "expected GPano metadata of a part"),
    "an infinite width": ({"gpano": {"FullPanoWidthPixels": "inf"}}, "expected GPano metadata of a part"),
    "a sliver": ({"gpano": {"CroppedAreaImageWidthPixels": 1}}, "expected an image of 1 to 360"),
    "a cubemap": ({"gpano": {"ProjectionType": "cubemap"}}, "found 'cubemap'; export it as one"),
    "no angles, and no shape": (
        {"gpano": {"FullPanoWidthPixels": None}, "crop": 300},
        "found 512x300 px without them; choose its projection (projection)",
    ),
}


def damage(scene, case):
    left, right = scene.left[: case.get("crop")], scene.right[: case.get("crop")]
    file = encode_jpeg(np.ascontiguousarray(right[:: case.get("smaller", 1), :: case.get("smaller", 1)]))
    file = case.get("right", file[: len(file) // case.get("cut", 1)])
    parts = make_extension(case.get("text", embed(file)), case.get("stated_bytes"), most=20_000)
    parts = [part for index, part in enumerate(parts) if index != case.get("drop")]
    gpano = make_gpano(512, 512, **case.get("gpano", {}))
    return make_vr180(left, None, gpano=gpano, extension=case.get("extension", parts))


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_vr180_photo_is_refused_in_one_line(tmp_path, half_scene, name):
    case, found = DAMAGED[name]
    path = tmp_path / "a.vr.jpg"
    path.write_bytes(damage(half_scene, case))
    message = refusal(path)
    assert message.startswith(str(path))
    assert found in message


def test_damaged_angles_do_not_matter_if_the_user_gives_the_projection(tmp_path, half_scene):
    path = tmp_path / "a.vr.jpg"
    path.write_bytes(damage(half_scene, {"gpano": {"FullPanoWidthPixels": "wide"}}))
    opened = open_pictures([path], None, SphereRequest(projection="half_equirectangular"))
    assert opened.sphere.projection.yaw_deg == (-90, 90)


def test_a_sliver_does_not_matter_if_the_user_gives_the_projection(tmp_path, half_scene):
    path = tmp_path / "a.vr.jpg"
    path.write_bytes(damage(half_scene, {"gpano": {"CroppedAreaImageWidthPixels": 1}}))
    opened = open_pictures([path], None, SphereRequest(projection="equirectangular"))
    assert opened.sphere.projection.yaw_deg == (-180, 180)


def test_the_field_of_view_of_a_lens_is_refused_for_an_equirectangular_file(tmp_path, half_scene):
    path = tmp_path / "a.vr.jpg"
    path.write_bytes(make_vr180(half_scene.left, half_scene.right))
    told = refusal(path, lens_fov_deg=190)
    assert f"expected only for a fisheye, found with {path}, which is half_equirectangular" in told
    assert "omit it, or choose " in told and "fisheye" in told
    assert open_pictures([path], None, SphereRequest(projection="fisheye", lens_fov_deg=190)).sphere


def test_a_panorama_for_one_eye_is_refused_as_such(tmp_path, half_scene):
    path = tmp_path / "a.jpg"
    xmp = b'<x GPano:ProjectionType="equirectangular"/>'
    Image.fromarray(half_scene.left[:256]).save(path, xmp=xmp)
    assert "expected a stereo picture" in refusal(path)
    assert "found a VR180 picture or a 360-degree panorama" in refusal(path, path)
    advice = "give it alone if it holds both eyes, or choose the projection (projection)"
    assert refusal(path, path).endswith(advice)


def test_two_panoramas_can_be_ordinary_pictures(tmp_path, half_scene):
    xmp = b'<x GPano:ProjectionType="equirectangular"/>'
    paths = [tmp_path / f"{eye}.jpg" for eye in ("left", "right")]
    for path, image in zip(paths, (half_scene.left, half_scene.right), strict=True):
        Image.fromarray(image).save(path, xmp=xmp)
    opened = open_pictures(paths, None, SphereRequest(projection="rectilinear"))
    assert opened.sphere is None and opened.pair.left.shape == (512, 512, 3)


def test_an_ordinary_pair_with_damaged_extended_metadata_opens(tmp_path, half_scene):
    path = tmp_path / "a.jpg"
    both = np.hstack([half_scene.left, half_scene.right])
    parts = make_extension(b'<rdf:Description crs:Look="warm"/>', 10_000_000)
    main = b'<x:xmpmeta xmpNote:HasExtendedXMP="0123456789ABCDEF0123456789ABCDEF"/>'
    path.write_bytes(make_vr180(both, None, gpano=main, extension=parts))
    assert open_pictures([path]).layout == "side_by_side"


@pytest.mark.testdata
def test_a_real_360_degree_pair_has_rows_that_match(testdata):
    path = testdata / "consumer" / "walrus-360.top-bottom.jpg"
    for look_deg in ((0, 0), (180, 0)):
        opened = open_pictures([path], None, SphereRequest(look_deg=look_deg))
        found = check_pair(opened.pair.left, opened.pair.right)
        assert found.vertical_error_95_px < 1.5 and not found.defects
