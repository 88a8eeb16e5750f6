r"""Equations, written as $...$ and $$...$$ in LaTeX, become MathML: browsers draw it without a script or a font file.

A number is given by \tag{6} and stands at the right.
"""

import html
import re

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
DISPLAYED = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
TAG = re.compile(r"\\tag\{([^}]*)\}")


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace each equation of a page's HTML."""
    place = page.file.src_uri
    content = DISPLAYED.sub(lambda match: _displayed(html.unescape(match[1]), place), content)
    return INLINE.sub(lambda match: math(html.unescape(match[1]), place), content)


def math(latex: str, place: str, *, display: str = "inline") -> str:
    """An equation as MathML.

    Raises:
        PluginError: LaTeX that the converter does not know, which it would leave standing as text; names it.
    """
    try:
        drawn = convert(latex.strip(), display=display)
    except Exception as error:
        raise PluginError(f"{place}: the equation {latex.strip()!r} is not understood: {error!r}") from error
    if "\\" in drawn:
        raise PluginError(f"{place}: the equation {latex.strip()!r} has a command that latex2mathml does not know")
    # An operator's space around the bars of |x| would tear it apart.
    return drawn.replace('<mo stretchy="false">&#x0007C;', '<mo stretchy="false" lspace="0" rspace="0">&#x0007C;')


def _displayed(latex: str, place: str) -> str:
    number = TAG.search(latex)
    shown = math(TAG.sub("", latex), place, display="block")
    beside = f'<span class="equation-number">({number[1]})</span>' if number else ""
    return f'<div class="equation">{shown}{beside}</div>'
