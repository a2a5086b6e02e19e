"""`report.html`: a comparison as one page that opens from disk, with all data, styles and scripts inside.

`page` fills the template; `content` and `charts` provide its words, tables and curves; `layers` selects the points of
the 3D view, and `packing` encodes them. `viewer/` has the scripts that draw them, in the order of `page.SCRIPTS`.
"""

from pcbench.report.html.page import page

__all__ = ["page"]
