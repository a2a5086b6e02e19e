"""Pages that open from disk, with all data, styles and scripts inside; `report.html` shows a comparison.

`template` fills a template and adds what all pages share, `base.html`. `page` and `page.html` are a comparison's:
`metrics_table`, `places` and `charts` provide its tables and curves; `layers` selects the points of the 3D view, and
`packing` encodes them. `viewer/` has the scripts that draw them, in the order of `page.SCRIPTS`.
"""

from pcbench.report.html.page import page

__all__ = ["page"]
