import struct

import pytest

from stereoweave.errors import FormatError
from stereoweave.io.boxes import (
    Box,
    change_boxes,
    find_boxes,
    make_box,
    make_full_box,
    split_boxes,
    split_readable_boxes,
)

FREE, DATA = make_box(b"free", b"abc"), make_box(b"mdat", b"defgh")
# A size of 1 stands for one of 64 bits after the type.
LONG = struct.pack(">I4sQ", 1, b"mdat", 21) + b"defgh"


def open_box(kind, content):
    """Return a box of size 0: it reaches to the end."""
    return struct.pack(">I4s", 0, kind) + content


def places(tmp_path, content, most=10):
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    with path.open("rb") as file:
        return [(place.kind, place.start, place.begin, place.end) for place in find_boxes(file, most)]


def readable(content):
    return [(box.kind, box.content) for box in split_readable_boxes(content)]


def test_a_box_starts_with_its_size_and_its_type():
    assert make_box(b"free", b"abc") == b"\0\0\0\x0bfreeabc"
    assert make_full_box(b"hfov", b"abc") == b"\0\0\0\x0fhfov\0\0\0\0abc"


def test_the_boxes_of_a_file_are_found_with_sizes_of_32_and_64_bits(tmp_path):
    assert places(tmp_path, FREE + LONG) == [(b"free", 0, 8, 11), (b"mdat", 11, 27, 32)]
    assert places(tmp_path, b"") == []


def test_more_boxes_than_allowed_are_refused(tmp_path):
    assert len(places(tmp_path, 3 * FREE, most=4)) == 3
    with pytest.raises(FormatError, match="expected at most 2 boxes, found more"):
        places(tmp_path, 3 * FREE, most=2)


@pytest.mark.parametrize(
    ("damaged", "found"),
    [
        (DATA[:-1], "b'mdat' with 13 bytes of which the file holds 12"),
        (struct.pack(">I4s", 7, b"mdat"), "b'mdat' with 7 bytes of which the file holds 8"),
        (struct.pack(">I4sQ", 1, b"mdat", 15), "b'mdat' with 15 bytes of which the file holds 16"),
        (struct.pack(">I4sQ", 1, b"mdat", 2**64 - 1), "b'mdat' with 18446744073709551615 bytes"),
        (struct.pack(">I4s", 1, b"mdat"), "b'mdat' with 0 bytes of which the file holds 8"),
    ],
)
def test_a_damaged_box_of_a_file_is_named(tmp_path, damaged, found):
    with pytest.raises(FormatError) as caught:
        places(tmp_path, FREE + damaged)
    assert f"expected whole boxes, found {found}" in str(caught.value)


def test_boxes_are_split_with_all_of_their_bytes():
    assert split_boxes(FREE + LONG) == [Box(b"free", b"abc", FREE), Box(b"mdat", b"defgh", LONG)]


def test_a_rest_shorter_than_a_box_has_no_type():
    assert split_boxes(FREE + bytes(4)) == [Box(b"free", b"abc", FREE), Box(b"", b"", bytes(4))]


@pytest.mark.parametrize("damaged", [DATA[:-1], open_box(b"mdat", b"defgh")])
def test_a_box_of_the_index_that_does_not_fit_or_has_no_size_is_refused(damaged):
    with pytest.raises(FormatError, match="expected boxes that fit into the index, found b'mdat'"):
        split_boxes(FREE + damaged)


def test_readable_boxes_end_before_a_damaged_one():
    whole = [(b"free", b"abc")]
    assert readable(FREE + LONG + FREE) == [*whole, (b"mdat", b"defgh"), *whole]
    assert readable(FREE + DATA[:-1]) == whole
    assert readable(FREE + struct.pack(">I4s", 7, b"mdat") + FREE) == whole
    assert readable(FREE + struct.pack(">I4sQ", 1, b"mdat", 15) + FREE) == whole
    assert readable(FREE + bytes(7)) == whole
    assert readable(b"") == []


def test_the_last_readable_box_may_have_no_size():
    assert readable(FREE + open_box(b"mdat", b"defgh")) == [(b"free", b"abc"), (b"mdat", b"defgh")]


def test_a_box_with_an_identifier_has_this_as_its_type():
    identifier = bytes(range(16))
    assert readable(make_box(b"uuid", identifier + b"abc")) == [(identifier, b"abc")]


def test_all_boxes_at_the_end_of_the_way_are_changed():
    boxes = FREE + make_box(b"moov", DATA + FREE + DATA)
    changed = change_boxes(boxes, [b"moov", b"mdat"], lambda content: content + b"!")
    longer = make_box(b"mdat", b"defgh!")
    assert changed == FREE + make_box(b"moov", longer + FREE + longer)


def test_a_way_that_leads_nowhere_changes_nothing_unless_it_is_needed():
    assert change_boxes(FREE, [b"moov"], bytes.upper) == FREE
    with pytest.raises(FormatError, match="expected the box moov in the index, found none"):
        change_boxes(FREE, [b"moov"], bytes.upper, needed=True)
