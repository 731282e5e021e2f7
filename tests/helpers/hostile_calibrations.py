"""Systematically generated malicious calibrations: HOSTILE must be refused quickly, HARMLESS read."""

import base64
import gzip
import struct

from fuzz.targets.calibrations import KALIBR, MIDDLEBURY

MATRIX = [500, 0, 320, 0, 500, 240, 0, 0, 1]
# Content of a calibration without nesting: a list is a matrix of three columns, or of one row.
RIG = {
    "M1": MATRIX,
    "D1": [0.1, -0.2, 0.001, 0.002, 0.03],
    "M2": MATRIX,
    "D2": [0.1, -0.2, 0.001, 0.002, 0.03],
    "R": [1, 0, 0, 0, 1, 0, 0, 0, 1],
    "T": [-0.1, 0, 0],
    "translation_unit": "m",
    "distortion_model": "radtan",
    "image_width": 640,
    "image_height": 480,
}
KITTI = "P0: 700 0 600 0 0 700 170 0 0 0 1 0\nP1: 700 0 600 -350 0 700 170 0 0 0 1 0\n"
_MANY = 60_000


def yaml_of(rig, header="%YAML:1.0\n---\n"):
    lines = (f"{name}: {value if isinstance(value, str) else _yaml(value)}\n" for name, value in rig.items())
    return header + "".join(lines)


def _yaml(value):
    if not isinstance(value, list):
        return str(value)
    rows, cols = _shape(value)
    data = ", ".join(map(str, value))
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]"


def json_of(rig):
    entries = ",\n".join(f'    "{name}": {_json(value)}' for name, value in rig.items())
    return f"{{\n{entries}\n}}\n"


def _json(value):
    if isinstance(value, str):
        return value if value[:1] in '{["' else f'"{value}"'
    if not isinstance(value, list):
        return str(value)
    rows, cols = _shape(value)
    data = ", ".join(map(str, value))
    return f'{{"type_id": "opencv-matrix", "rows": {rows}, "cols": {cols}, "dt": "d", "data": [ {data} ]}}'


def xml_of(rig, doctype=""):
    entries = "\n".join(_xml(name, value) for name, value in rig.items())
    return f'<?xml version="1.0"?>\n{doctype}<opencv_storage>\n{entries}\n</opencv_storage>\n'


def _xml(name, value):
    if not isinstance(value, list):
        return f"<{name}>{value}</{name}>"
    rows, cols = _shape(value)
    return (
        f'<{name} type_id="opencv-matrix"><rows>{rows}</rows><cols>{cols}</cols><dt>d</dt>\n'
        f"  <data>{' '.join(map(str, value))}</data></{name}>"
    )


def _shape(value):
    return (3, 3) if len(value) == 9 else (1, len(value))


def _aliases():
    laughs = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    laughs += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)]
    return {
        "recursive list": "M1: &a [*a, *a, *a]\n",
        "recursive list in a rig": yaml_of(RIG | {"M1": "&a [*a, *a, *a]"}),
        "recursive map": "M1: &a {rows: *a, cols: *a, data: *a}\n",
        "recursive key": "? &a [*a]\n: 1\n",
        "recursive matrix": "M1: &a !!opencv-matrix {rows: 3, cols: 3, data: *a}\n",
        "recursive merge": "&a\n<<: *a\nM1: 1\n",
        "nested": "\n".join(laughs) + "\nM1: *a9\n",
        "nested in a rig": yaml_of(RIG | {"M1": "*a9"}, header="\n".join(laughs) + "\n"),
        "recursive camera": KALIBR.replace("[61.6, 60.3, 36.0, 24.1]", "&a [*a, *a, *a, *a]"),
        "undefined": "M1: *a\n",
        "in json": '{"M1": &a [*a, *a, *a]}\n',
        "none, but an anchor": yaml_of(RIG | {"points": "&t [1, 2]"}),
    }


def _nesting():
    openings = {"[": "]", "{a: ": "}", '{"a": ': "}", "- ": "", "? ": ""}
    alone = {f"{opening!r} {_MANY} deep": opening * _MANY for opening in openings}
    closed = {
        f"{opening!r} 5000 deep and closed": opening * 5000 + "1" + closing * 5000
        for opening, closing in openings.items()
    }
    indented = "".join(f"{' ' * depth}a:\n" for depth in range(700))
    xml = {
        f"<{name}> 30000 deep{' and closed' * closed}": '<?xml version="1.0"?><opencv_storage><M1>'
        + f"<{name}>" * 30_000
        + (f"</{name}>" * 30_000 + "</M1></opencv_storage>") * closed
        for name, closed in (("_", False), ("_", True), ("a", False), ("a", True))
    }
    return {
        **alone,
        **closed,
        **xml,
        "indented 700 deep": indented,
        "json list 60000 deep": '{"M1": ' + "[" * _MANY,
        "json list 60000 deep and closed": '{"M1": ' + "[" * _MANY + "]" * _MANY + "}",
        "json matrix 5000 deep": '{"M1": {"data": ' * 5000 + "1" + "}" * 10_000,
        "yaml matrix 5000 deep": "M1: "
        + "!!opencv-matrix {rows: 1, cols: 1, data: " * 5000
        + "1"
        + "}" * 5000,
        "kalibr 5000 deep": KALIBR.replace("[72, 48]", "[" * 5000 + "]" * 5000),
    }


def _size():
    return {
        "comment of a megabyte": yaml_of(RIG) + "#" + "a" * 10**6,
        "blanks before it": " " * 10**6 + yaml_of(RIG),
        "xml comment of a megabyte": xml_of(RIG) + f"<!--{'a' * 10**6}-->",
        "json of a megabyte": json_of(RIG) + " " * 10**6,
        "middlebury line of a megabyte": MIDDLEBURY + "ndisp=" + "7" * 10**6,
        "kitti line of a megabyte": KITTI + "P2:" + " 1" * 500_000,
        "camchain of a megabyte": KALIBR + "# \n" * 400_000,
    }


def _count():
    numbers = ",".join("1" * 120_000)
    return {
        "numbers in a yaml list": f"{yaml_of(RIG)}points: [{numbers}]\n",
        "numbers in a json list": json_of(RIG | {"points": f"[{numbers}]"}),
        "numbers in yaml lines": yaml_of(RIG) + "points:\n" + "- 1\n" * _MANY,
        "entries of yaml": yaml_of(RIG) + "".join(f"{i}: 1\n" for i in range(25_000)),
        "numbers in xml": xml_of(RIG | {"points": "1 " * 12_000}),
        "numbers in lines of xml": xml_of(RIG | {"points": "1\n" * 12_000}),
        "elements of xml": xml_of(RIG | {"points": "<_/>" * 60_000}),
        "documents": "---\n" * _MANY,
        "anchors": yaml_of(RIG) + "points:\n" + "".join(f"- &{i} 1\n" for i in range(20_000)),
        "coefficients": xml_of(RIG | {"D1": [1] * 100_000}),
        "distances of kitti": f"{KITTI}P1:{' 1' * 120_000}\n",
        "rows of middlebury": MIDDLEBURY.replace("0 0 1]", "0 0 1" + ";" * 200_000 + "]", 1),
    }


def _scalars():
    values = {
        "digits": "9" * 100_000,
        "1e400": "1e400",
        "a fraction of 100000 digits": "1/" + "3" * 100_000,
        "opencv's nan": ".Nan",
        "opencv's infinity": "-.Inf",
        "nan": "nan",
        "a word": "five",
        "sexagesimal": "1" + ":59" * 30_000,
        "hexadecimal": "0x" + "f" * 100_000,
        "binary": "0b" + "1" * 100_000,
        "date": "2001-99-99",
        "null": "~",
    }
    matrices = {f"matrix of {what}": [value, *MATRIX[1:]] for what, value in values.items()}
    return {
        **{f"yaml {what}": yaml_of(RIG | {"M1": value}) for what, value in matrices.items()},
        **{f"xml {what}": xml_of(RIG | {"M1": value}) for what, value in list(matrices.items())[:7]},
        **{f"json {what}": json_of(RIG | {"M1": value}) for what, value in list(matrices.items())[:7]},
        "width of 5000 digits": yaml_of(RIG | {"image_width": "9" * 5000}),
        "width of infinity": yaml_of(RIG | {"image_width": "1e999"}),
        "width of nothing": yaml_of(RIG | {"image_width": 0}),
        "unit of 200000 letters": yaml_of(RIG | {"translation_unit": "m" * 200_000}),
        "unit of two lines": json_of(RIG | {"translation_unit": '"m\\nerror: none"'}),
        "unit of half a character": json_of(RIG | {"translation_unit": '"\\ud800"'}),
        "unit of an escape": yaml_of(RIG | {"translation_unit": '"\\e[2J"'}),
        "unit of a list": yaml_of(RIG | {"translation_unit": "[[[[m]]]]"}),
        "middlebury width of 5000 digits": MIDDLEBURY.replace("72", "9" * 5000),
        "middlebury baseline of nan": MIDDLEBURY.replace("193.001", "nan"),
        "middlebury doffs of 100000 letters": MIDDLEBURY.replace("doffs=2", "doffs=" + "a" * 100_000),
        "middlebury focal of infinity": MIDDLEBURY.replace("60", "inf"),
        "kitti focal of nan": KITTI.replace("700", "nan"),
        "kitti focal of 0": KITTI.replace("700", "0"),
    }


def _tags():
    tags = {
        "python call": '!!python/object/apply:os.system ["exit 1"]',
        "python name": "!!python/name:os.system",
        "python module": "!!python/module:antigravity",
        "binary": "!!binary AAAA",
        "set": "!!set {a, b}",
        "pairs": "!!pairs [a: 1]",
        "own": "!harm [1, 2]",
        "undefined handle": "!a!b [1, 2]",
    }
    return {what: yaml_of(RIG | {"M1": value}) for what, value in tags.items()} | {
        "200000 letters": yaml_of(RIG | {"M1": f"!<{'a' * 200_000}> 1"}),
        "directives": "%TAG !a! tag:a,2000:\n" * 10_000 + yaml_of(RIG, header="---\n"),
    }


def _entities():
    laughs = '<!ENTITY a0 "1 1 1 1 1 1 1 1 1 1">'
    laughs += "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10))
    width = {"image_width": "&a9;"}
    doctypes = {
        "billion laughs": laughs,
        "quadratic": f'<!ENTITY a9 "{"1 " * 50_000}">',
        "external": '<!ENTITY a9 SYSTEM "file:///etc/hostname">',
        "from the network": '<!ENTITY a9 SYSTEM "http://127.0.0.1:9/">',
        "parameter": '<!ENTITY % p SYSTEM "file:///etc/hostname"> %p; <!ENTITY a9 "640">',
        "short": '<!ENTITY a9 "640">',
        "recursive": '<!ENTITY a9 "&a9;">',
    }
    return {
        **{
            what: xml_of(RIG | width, doctype=f"<!DOCTYPE opencv_storage [{entities}]>\n")
            for what, entities in doctypes.items()
        },
        "undefined": xml_of(RIG | width),
        "dtd of another file": xml_of(RIG, doctype='<!DOCTYPE a SYSTEM "file:///etc/hostname">\n'),
        "empty dtd": xml_of(RIG, doctype="<!DOCTYPE opencv_storage>\n"),
        "nested dtd": xml_of(
            RIG, doctype="<!DOCTYPE a [<!ELEMENT a " + "(" * 50_000 + "a" + ")" * 50_000 + ">]>\n"
        ),
    }


def _damaged():
    whole = {
        "yaml": yaml_of(RIG),
        "json": json_of(RIG),
        "xml": xml_of(RIG),
        "kalibr": KALIBR,
        "kitti": KITTI,
        "middlebury": MIDDLEBURY,
    }
    cut = {f"half of {what}": text[: len(text) // 2] for what, text in whole.items()}
    return {
        **cut,
        "xml of two roots": xml_of(RIG) + "<opencv_storage/>",
        "xml of another root": xml_of(RIG).replace("opencv_storage", "svg"),
        "xml that closes another": xml_of(RIG).replace("</M1>", "</M2>"),
        "brackets that do not match": yaml_of(RIG).replace(" ]", " }"),
        "quote that does not end": '{"' + '\\"' * 100_000,
        "quotes that do not end": '"' * 100_001,
        "comments of json": "{" + "//" * 100_000,
        "nothing": "",
        "middlebury's name alone": "cam0" + "\n" * 100_000 + "doffs" + "\n" * 100_000,
        "kitti's names alone": "P0:" * 80_000,
        "equals signs": "cam0=" + "=" * 200_000,
    }


def _binary():
    return {
        "zeros": bytes(100_000),
        "ones": b"\xff" * 100_000,
        "every byte": bytes(range(256)) * 100,
        "picture": b"\x89PNG\r\n\x1a\n" + bytes(1000),
        "program": b"\x7fELF\x02\x01\x01" + bytes(1000),
        "compressed": gzip.compress(yaml_of(RIG).encode(), mtime=0),
        "compressed zeros": gzip.compress(bytes(10**7), mtime=0),
        "utf-16": yaml_of(RIG).encode("utf-16"),
        "utf-16 xml": xml_of(RIG).encode("utf-16"),
        "zero inside": yaml_of(RIG).encode().replace(b"image_width", b"image\0width"),
        "zero inside xml": xml_of(RIG).encode().replace(b"image_width", b"image\0width"),
    }


def _base64(kind, *numbers):
    content = kind.encode().ljust(24) + struct.pack(f"<{len(numbers)}d", *numbers)
    return base64.b64encode(content).decode()


def _matrices():
    def lying(rows=3, cols=3, data=tuple(MATRIX), dt="d"):
        numbers = data if isinstance(data, str) else f"[{', '.join(map(str, data))}]"
        return (
            f'{{"type_id": "opencv-matrix", "rows": {rows}, "cols": {cols}, "dt": "{dt}", "data": {numbers}}}'
        )

    lies = {
        "a billion rows": lying(rows=10**9),
        "rows that overflow": lying(rows=2**62, cols=4),
        "rows of 40 digits": lying(rows=10**40),
        "rows of infinity": lying(rows="1e999"),
        "rows of a word": lying(rows="three"),
        "rows below zero": lying(rows=-1),
        "rows and columns below zero": lying(rows=-3, cols=-3),
        "rows of a list": lying(rows="[3]"),
        "numbers too few": lying(data=MATRIX[:8]),
        "numbers too many": lying(data=MATRIX * 2),
        "no numbers": lying(data=()),
        "numbers of a map": lying(data='{"a": 1}'),
        "numbers of two lengths": lying(data="[[1, 2], [3]]"),
        "numbers of a word": lying(data='"word"'),
        "a billion channels": lying(dt="1000000000d"),
        "base64 of nothing": lying(data='"$base64$"'),
        "base64 that is none": lying(data='"$base64$' + "?" * 1000 + '"'),
        "base64 too short": lying(data=f'"$base64${_base64("1d", 1.0)}"'),
        "base64 of another kind": lying(data=f'"$base64${_base64("1z", *MATRIX)}"'),
        "base64 cut off": lying(data=f'"$base64${_base64("1d", *MATRIX)[:-5]}"'),
        "base64 of nan": lying(data=f'"$base64${_base64("1d", *[float("nan")] * 9)}"'),
        "a map": '{"a": 1}',
        "a list of maps": '[{"a": 1}]',
        "lists of two lengths": "[[1, 0, 0], [0, 1]]",
        "nothing": '""',
    }
    return {what: json_of(RIG | {"M1": value}) for what, value in lies.items()} | {
        f"{what} of yaml": yaml_of(RIG | {"M1": value}, header="") for what, value in lies.items()
    }


def _rigs():
    changes = {
        "a mirror": {"R": [-1, 0, 0, 0, 1, 0, 0, 0, 1]},
        "no rotation": {"R": [0] * 9},
        "a huge rotation": {"R": [1e200] * 9},
        "one place": {"T": [0, 0, 0]},
        "a place too far": {"T": [1e200, 1e200, 0]},
        "a focal length below zero": {"M1": [-500, *MATRIX[1:]]},
        "skew": {"M1": [500, 1, *MATRIX[2:]]},
        "a focal length of 1e300": {"M1": [1e300, *MATRIX[1:]]},
        "a centre of -1e60": {"M2": [*MATRIX[:2], -1e60, *MATRIX[3:]]},
        "coefficients of 1e20": {"D2": [1e20] * 5},
        "a baseline of 1e12": {"T": [-1e12, 0, 0]},
        "six coefficients": {"D1": [0] * 6},
        "a size of three": {"image_size": "[640, 480, 3]"},
        "a lens of no kind": {"distortion_model": "x" * 100_000},
    }
    return {what: yaml_of(RIG | change) for what, change in changes.items()} | {
        "kitti without a row": KITTI.splitlines()[0],
        "middlebury doffs of 1e300": MIDDLEBURY.replace("doffs=2", "doffs=1e300"),
        "middlebury baseline of 1e150": MIDDLEBURY.replace("193.001", "1e150"),
        "kitti of 11 numbers": KITTI.replace("0 0 1 0", "0 0 1"),
        "kalibr of one camera": KALIBR.replace("cam1", "cam2"),
        "kalibr of maps": KALIBR.replace("[61.6, 60.3, 36.0, 24.1]", "{a: 1, b: 2, c: 3, d: 4}"),
        "middlebury without size": MIDDLEBURY.replace("width", "w"),
    }


def _flattened(**rules):
    texts = {f"{rule}: {what}": text for rule, made in rules.items() for what, text in made.items()}
    return {name: text.encode() if isinstance(text, str) else text for name, text in texts.items()}


HOSTILE = _flattened(
    aliases=_aliases(),
    nesting=_nesting(),
    size=_size(),
    count=_count(),
    scalars=_scalars(),
    tags=_tags(),
    entities=_entities(),
    damaged=_damaged(),
    binary=_binary(),
    matrices=_matrices(),
    rigs=_rigs(),
)


def _harmless():
    yaml, json, xml = yaml_of(RIG), json_of(RIG), xml_of(RIG)
    base64_matrix = f'{{"rows": 3, "cols": 3, "dt": "d", "data": "$base64${_base64("1d", *MATRIX)}"}}'
    odd = "a: 2001-99-99\nb: .Nan\nc: ~\nd: !!binary AAAA\ne: 1:59\n<<: {f: 1}\n"
    return {
        "mark of utf-8": "\ufeff" + yaml,
        "mark of utf-8 in xml": "\ufeff" + xml,
        "lines of windows": yaml.replace("\n", "\r\n"),
        "tabs in json": json.replace("    ", "\t"),
        "json in one line": json.replace("\n", ""),
        "comments of opencv's json": json.replace("{\n", "{\n    // a comment\n", 1).replace(
            "}\n", "} // a\n"
        ),
        "slashes in a string of json": json_of(RIG | {"made by": '"https://example.org \\"//\\""'}),
        "comments of xml": xml.replace("<M1", "<!-- &a; <_> --><M1"),
        "character references of xml": xml_of(RIG | {"translation_unit": "&#109;"}),
        "section of xml": xml_of(RIG | {"translation_unit": "<![CDATA[m]]>"}),
        "200000 letters of comment": yaml + "#" + "a" * 200_000,
        "comment that is no utf-8": yaml.encode() + b"# \xe9\xff\n",
        "other values beside it": yaml + odd,
        "5000 numbers beside it": f"{yaml}points: [{', '.join('1' * 5000)}]\n",
        "9000 numbers of xml beside it": xml_of(RIG | {"points": "1 " * 9000}),
        "lists in lists beside it": f"{yaml}points: {'[' * 10}1{']' * 10}\n",
        "end of the document": yaml + "...\n",
        "header of yaml 1.2": yaml_of(RIG, header="%YAML 1.2\n---\n"),
        "base64 of json": json_of(RIG | {"M1": base64_matrix}),
        "entry of python": yaml + "made: !!python/object/apply:os.system [exit 1]\n",
        "camchain with comments": KALIBR.replace("cam1:", "# a comment\ncam1:"),
        "kitti with a date": "calib_time: 09-Jan-2012 13:57:47\n" + KITTI,
        "middlebury with 200000 blanks": MIDDLEBURY + " " * 200_000,
    }


HARMLESS = _flattened(harmless=_harmless())
