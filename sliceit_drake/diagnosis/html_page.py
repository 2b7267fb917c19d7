"""Self-contained HTML pages: text, and figures in them."""

import base64
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["html_page", "image"]

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#111827;
max-width:62rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}
pre{background:#f3f4f6;padding:1rem;overflow-x:auto;font-size:13px}
img{max-width:100%}
"""


def html_page(title: str, parts: Sequence[str]) -> str:
    """A page with a title and parts, which are HTML."""
    head = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title>",
        f"<style>{STYLE}</style>",
    ]
    return "\n".join([*head, *parts, "</html>", ""])


def image(figure: "Figure") -> str:
    """A figure as an element of a page."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    code = base64.b64encode(stream.getvalue()).decode()
    return f'<img alt="figure" src="data:image/png;base64,{code}">'
