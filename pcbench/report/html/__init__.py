"""Pages that open from disk, with all data, styles and scripts inside: `report.html` of a comparison or of a study.

`template` fills a template and adds what all pages share, `base.html`.

A comparison's page is `page` and `page.html`: `metrics_table`, `places`, `tiles` and `charts` provide its tables, maps
and curves; `layers` selects the points of the 3D view, and `packing` encodes them. `viewer/` has the scripts that draw
them, in the order of `page.SCRIPTS`. A study's page is `article` and `article.html`; `embedding` puts its pictures
inside.
"""

from pcbench.report.html.article import article_page
from pcbench.report.html.page import page
from pcbench.report.html.template import PAGE, InputRow, Origin, write_page

__all__ = ["PAGE", "InputRow", "Origin", "article_page", "page", "write_page"]
