"""Style and script of the report of an exam, beside those of every page."""

from __future__ import annotations

from scm_world.discovery.exam.side_by_side import VERDICTS

STYLE = """svg.shared{position:absolute}svg.graph{display:block;max-width:100%;height:auto}
svg text{font:10px sans-serif;fill:#222;text-anchor:middle}svg text.r{text-anchor:end}
svg text.u{text-anchor:start}
.n rect{fill:#f4f6f9;fill-opacity:.85;stroke:#6b7686}.grid{stroke:#dde1e7;fill:none}
svg .e text{stroke:none}svg .e text.lag{font-size:9px;text-anchor:start;font-style:italic}
.e{fill:none}.e.hot{stroke-width:5}.bare{marker-end:none!important}
.y{marker-end:none;stroke-dasharray:1 0;stroke-width:1.7;stroke-opacity:1}.y circle{fill:#fff;
stroke-width:1}
svg .m text{font-size:12px;font-weight:bold}svg .m.small text{font-size:8px}
.m.hot text{font-size:18px}.plain .e{stroke:#444;marker-end:url(#tip-undirected)}
.plain .unscored{stroke:#6B7280}.plain tspan{fill:#444}
"""

SCRIPT = """for(const svg of document.querySelectorAll("svg.found")){
  const edges=[...svg.querySelectorAll(".e")],say=svg.parentNode.querySelector("output");let at=-1;
  const show=i=>{edges[at]?.classList.remove("hot");at=i;edges[i]?.classList.add("hot");
    say.textContent=edges[i]?.querySelector("title")?.textContent??""};
  svg.addEventListener("pointerover",e=>show(edges.indexOf(e.target.closest(".e"))));
  svg.addEventListener("blur",()=>show(-1));
  svg.addEventListener("keydown",e=>{const step={ArrowRight:1,ArrowLeft:-1}[e.key];
    if(step&&edges.length){e.preventDefault();show((at+step+edges.length)%edges.length)}})}
"""


def verdicts() -> str:
    """Write the looks of the verdicts."""
    return "".join(
        f".{v.name}{{stroke:{v.color};stroke-width:{v.width};stroke-dasharray:{v.dashes};"
        f"marker-end:url(#tip-{v.name})}}"
        f".t-{v.name}{{color:{v.color};fill:{v.color}}}\n"
        for v in VERDICTS
    )
