"""The text of a URDF file -> its root element, by the rules that URDF parsers follow in practice.

Prefixes are part of names, as in the parsers of ROS: `drake:gear_ratio` needs no declared namespace, and a default
namespace means nothing. The encoding is the one that the file declares.
"""

from __future__ import annotations

import codecs
import re
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from ce_gym.model.errors import RobotError, invalid_value
from ce_gym.model.formats.text_file import one_line, read_bytes

XACRO_DEFINITIONS = ("xacro:property", "xacro:arg")
"""Elements of xacro that add no links or joints."""
BYTE_ORDER_MARKS = (
    *((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32")),
    *((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")),
    *((b"<\0", "utf-16-le"), (b"\0<", "utf-16-be")),  # no mark, but the first character of every XML file
)
ENCODINGS = ("utf", "iso8859", "cp", "ascii", "gb", "hz", "big5", "shift_jis", "euc", "koi8", "mac")
"""What names of character sets start with in Python; some of its other codecs take very long for large files."""


def parse_urdf(path: Path) -> Element:
    """Return the root element of a file.

    Raises:
        RobotError: The file cannot be read, is not XML, has a document type, or is xacro that was not expanded.
    """
    text = _decoded(path, read_bytes(path, "a URDF file")).lstrip()  # some files begin with a space
    builder = TreeBuilder()
    parser = expat.ParserCreate("utf-8")  # whatever the text itself declares
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data

    def refuse_document_type(*_: object) -> None:  # it can define entities, which read files or grow without bound
        raise RobotError(f"{path}: there is a <!DOCTYPE>: expected a URDF without document type and entities")

    parser.StartDoctypeDeclHandler = refuse_document_type
    try:
        parser.Parse(text.encode(), True)
        root = builder.close()
    except (expat.ExpatError, AssertionError, ValueError, LookupError) as error:
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"{path}: malformed XML: expected a URDF file ({one_line(error)})") from None
    if root.tag != "robot":
        raise invalid_value(str(path), "root element", root.tag, "<robot>")
    _refuse_xacro(str(path), root)
    return root


def _decoded(path: Path, data: bytes) -> str:
    """Return the text of a file in the encoding that a byte order mark or its XML declaration says; else UTF-8."""
    declared = re.match(rb"""\s*<\?xml[^>]*?encoding\s*=\s*["']([\w.:-]+)""", data)
    encoding = declared[1].decode("ascii", "replace") if declared else "utf-8"
    if re.match("utf-?(16|32)|ucs", encoding, re.IGNORECASE):
        encoding = "utf-8"  # the declaration was read byte by byte, so it is wrong
    encoding = next((name for mark, name in BYTE_ORDER_MARKS if data.startswith(mark)), encoding)
    try:
        if not codecs.lookup(encoding).name.startswith(ENCODINGS):
            raise LookupError(f"unknown encoding: {encoding}")
        text = data.decode(encoding)
        text.encode()
    except (LookupError, ValueError) as error:
        expected = "text in the encoding that its <?xml encoding> declares, UTF-8 without one"
        raise RobotError(f"{path}: cannot be read: expected {expected} ({one_line(error)})") from None
    return text


def _refuse_xacro(file: str, root: Element) -> None:
    """Refuse a file with macros that were not expanded: links and numbers are missing."""
    for element in root.iter():
        wants = element.tag.startswith("xacro:") and element.tag not in XACRO_DEFINITIONS
        texts = (*element.attrib.values(), element.text or "")
        value = next((text for text in texts if "${" in text or "$(" in text), None)
        if wants or (value is not None and not element.tag.startswith("xacro:")):
            value = f"<{element.tag}>" if wants else value
            raise invalid_value(file, "xacro", value, "a plain URDF; expand it first: xacro FILE > robot.urdf")
