"""TeX as MathML, which browsers draw by themselves: no script, nothing from elsewhere."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from latex2mathml.converter import convert
from markdown.util import AtomicString


def inline(source: str, language: str, css_class: str, md: Any) -> ElementTree.Element:
    """``#!math x`` between backticks."""
    box = ElementTree.Element("span", {"class": css_class})
    box.append(ElementTree.fromstring(convert(source, xmlns="")))
    for part in box.iter():
        part.text = AtomicString(part.text or "")  # "*" is no emphasis here
    return box


def block(source: str, language: str, css_class: str, options: dict, md: Any, **rest: Any) -> str:
    """A fence of the language ``math``."""
    return f'<div class="{css_class}">{convert(source, display="block")}</div>'
