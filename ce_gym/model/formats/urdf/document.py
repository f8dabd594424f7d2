"""The text of a URDF file -> its root element, by the rules that URDF parsers follow in practice.

Prefixes are part of names, as in the parsers of ROS: `drake:gear_ratio` needs no declared namespace, and a default
namespace means nothing. The encoding is the one that the file declares.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from ce_gym.model.errors import RobotError, bad
from ce_gym.model.formats.text_file import one_line, read_bytes

XACRO_DEFINITIONS = ("xacro:property", "xacro:arg")
"""Elements of xacro that add nothing to a robot by themselves."""


def parse_urdf(path: Path) -> Element:
    """Return the root element of a file.

    Raises:
        RobotError: The file cannot be read, is not XML, has a document type, or is xacro that was not expanded.
    """
    text = read_bytes(path, "a URDF file").lstrip()  # a declaration must come first, and some files begin with a space
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data

    def refuse_document_type(*_: object) -> None:  # it can define entities, which read files or grow without bound
        raise RobotError(f"{path}: there is a <!DOCTYPE>: expected a URDF without document type and entities")

    parser.StartDoctypeDeclHandler = refuse_document_type
    try:
        parser.Parse(text, True)
        root = builder.close()
    except (expat.ExpatError, AssertionError, ValueError, LookupError) as error:
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"{path}: malformed XML: expected a URDF file ({one_line(error)})") from None
    if root.tag != "robot":
        raise bad(str(path), "root element", root.tag, "<robot>")
    _refuse_xacro(str(path), root)
    return root


def _refuse_xacro(file: str, root: Element) -> None:
    """Refuse a file whose macros were not expanded: links and numbers are missing in it."""
    for element in root.iter():
        wants = element.tag.startswith("xacro:") and element.tag not in XACRO_DEFINITIONS
        value = next((value for value in element.attrib.values() if "${" in value or "$(" in value), None)
        if wants or (value is not None and not element.tag.startswith("xacro:")):
            found = f"<{element.tag}>" if wants else value
            raise bad(file, "xacro", found, "a plain URDF; expand it first: xacro FILE > robot.urdf")
