"""Safe parsing of YAML, JSON and XML from untrusted files into plain values.

Anchors, aliases and DTDs are refused, custom types are never instantiated, and the nesting and the number of
values are checked before any recursion. The parsing time is proportional to the length of the text, which
the caller limits.
"""

import re
from typing import Any
from xml.etree import ElementTree

import yaml

_MOST_DEEP, _MOST_VALUES = 20, 10_000
_NULLS = ("", "~", "null", "Null", "NULL")
BASE64 = "$base64$"  # OpenCV's mark of binary data in JSON
_DECLARATION = re.compile(r"<!(?!--|\[CDATA\[)")
_XML_ITEM = re.compile(r'"[^"]*"|\S+')
# Comments and tabs in JSON written by OpenCV and others. Strings, terminated or not, also match and are kept.
_JSON_ALONE = re.compile(r'("(?:[^"\\]|\\.)*+"?)|//.*|\t')


def parse_entries(text: str) -> dict[str, Any]:
    """Parse YAML, JSON, or the XML that cv2.FileStorage writes.

    Returns:
        Entries by name. A value is an unconverted string, or a list or dict of values; binary data is a
        string that begins with BASE64. Entries that are null in YAML or JSON are left out.

    Raises:
        ValueError or SyntaxError: The text has another format, contains an anchor, an alias or a DTD, is
            nested more than 20 levels deep, or has more than 10,000 values.
    """
    start = text.lstrip()[:1]
    if start == "<":
        entries = _parse_xml(text)
    else:
        entries = _parse_yaml(_JSON_ALONE.sub(r"\1 ", text) if start == "{" else text)
    if not isinstance(entries, dict):
        raise ValueError("no named entries")
    return entries


class _Gate:
    """Limits on the nesting and the number of values, which a parser checks before it enters each value."""

    def __init__(self) -> None:
        self._depth = self._values = 0

    def enter(self) -> None:
        self._depth += 1
        if self._depth > _MOST_DEEP:
            raise ValueError(f"values nested more than {_MOST_DEEP} levels deep")
        self.count(1)

    def count(self, values: int) -> None:
        self._values += values
        if self._values > _MOST_VALUES:
            raise ValueError(
                f"more than {_MOST_VALUES} values; remove entries that do not describe the cameras, such as "
                "image_points"
            )

    def leave(self) -> None:
        self._depth -= 1


class _Loader(yaml.BaseLoader):
    """PyYAML loader that builds only strings, lists and dicts and ignores other tags."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._gate = _Gate()

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise ValueError("an alias (*); replace it with its value")
        self._gate.enter()
        node = super().compose_node(parent, index)
        if self.anchors:  # useless without aliases
            raise ValueError("an anchor (&); remove it")
        self._gate.leave()
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        node.value = [(key, value) for key, value in node.value if not _is_null(value)]
        return super().construct_mapping(node, deep)


def _is_null(node: yaml.Node) -> bool:
    return (
        isinstance(node, yaml.ScalarNode)
        and node.style is None  # without quotes
        and node.tag == yaml.resolver.BaseResolver.DEFAULT_SCALAR_TAG
        and node.value in _NULLS
    )


def _mark_binary(loader: _Loader, node: yaml.ScalarNode) -> str:
    return BASE64 + str(loader.construct_scalar(node))


_Loader.add_constructor("tag:yaml.org,2002:binary", _mark_binary)


def _parse_yaml(text: str) -> Any:
    try:
        # OpenCV writes an invalid directive, with a colon.
        return yaml.load(re.sub(r"\A\s*%YAML.*", "", text), _Loader)
    except yaml.MarkedYAMLError as error:
        where = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ValueError(f"it is not valid YAML{where}") from error
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


class _Builder(ElementTree.TreeBuilder):
    """ElementTree builder with limits on the nesting and the number of values."""

    def __init__(self) -> None:
        super().__init__()
        self._gate = _Gate()

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self._gate.enter()
        return super().start(tag, attrs)

    def data(self, data: str, /) -> None:
        self._gate.count(len(_XML_ITEM.findall(data)))
        super().data(data)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._gate.leave()
        return super().end(tag)


def _parse_xml(text: str) -> Any:
    # DTDs are refused before parsing, because entities can include files and expand without limit.
    if _DECLARATION.search(text):
        raise ValueError("XML with a DTD")
    root = ElementTree.fromstring(text, parser=ElementTree.XMLParser(target=_Builder()))
    if root.tag != "opencv_storage":
        raise ValueError("XML not written by OpenCV")
    return _xml_value(root)


def _xml_value(element: ElementTree.Element) -> Any:
    text = element.text or ""
    if element.get("type_id") == "binary":
        return BASE64 + text
    if any(child.tag != "_" for child in element):
        return {child.tag: _xml_value(child) for child in element}
    items = _xml_items(text)
    for child in element:
        items += [_xml_value(child), *_xml_items(child.tail or "")]
    return items[0] if len(items) == 1 and not len(element) else items


def _xml_items(text: str) -> list[Any]:
    """Split the text of a sequence into numbers and words; words that contain spaces are quoted."""
    return [item.strip('"') for item in _XML_ITEM.findall(text)]
