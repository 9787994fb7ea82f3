"""Which colours and lines does a picture have?"""

from __future__ import annotations

from typing import Final

# The fallbacks serve where the page has no Jupyter theme: dark text on light vertices, grey edges, readable on white
# and on black paper alike.
STYLE: Final = """
.epypes-graph{max-width:100%;height:auto;font:12px var(--jp-ui-font-family,system-ui,sans-serif)}
.epypes-graph text{fill:var(--jp-ui-font-color1,#1f2328);text-anchor:middle;stroke:none}
.epypes-graph .small{font-size:10px}
.epypes-graph .name{font-weight:600}
.epypes-graph .shape{fill:var(--jp-layout-color1,#fff);stroke:#80868f}
.epypes-graph .function .shape{fill:var(--jp-layout-color2,#e9eef6);stroke-width:1.4}
.epypes-graph .function .shape{stroke:var(--jp-brand-color1,#1976d2)}
.epypes-graph .hyperparameter .shape{fill:var(--jp-layout-color3,#dcdfe4)}
.epypes-graph .bar{fill:var(--jp-brand-color1,#1976d2)}
.epypes-graph .planned .shape{stroke-width:3}
.epypes-graph .redefined .shape{stroke:var(--jp-warn-color1,#e65100);stroke-width:3}
.epypes-graph .missing .shape{stroke:var(--jp-error-color1,#d32f2f);stroke-width:2}
.epypes-graph .left-out .shape{stroke-dasharray:2 3}
.epypes-graph .left-out{opacity:.6}
.epypes-graph .failed .shape{stroke:var(--jp-error-color1,#d32f2f);stroke-width:3}
.epypes-graph .stale .shape,.epypes-graph .not-computed .shape,.epypes-graph .not-run .shape{stroke-dasharray:2 3}
.epypes-graph .placeholder .shape{stroke-dasharray:7 4}
.epypes-graph .stale image{opacity:.35}
.epypes-graph .stale .chart,.epypes-graph .stale .row{opacity:.5}
.epypes-graph .row{font:10px var(--jp-code-font-family,ui-monospace,monospace);text-anchor:start;white-space:pre}
.epypes-graph .frame{fill:var(--jp-layout-color2,#f1f3f6)}
.epypes-graph .chart path,.epypes-graph .chart polyline{fill:none;stroke:var(--jp-brand-color1,#1976d2)}
.epypes-graph .chart .dots{stroke-width:3;stroke-linecap:round}
.epypes-graph .function .inner{fill:none;stroke-width:1}
.epypes-graph .edge{fill:none;stroke:#80868f}
.epypes-graph .dense{stroke-width:.5}
.epypes-graph .tip{fill:#80868f}
.epypes-graph .off{opacity:.6}
.epypes-graph .edge.off{stroke-dasharray:4 4}
""".replace("\n", "")
