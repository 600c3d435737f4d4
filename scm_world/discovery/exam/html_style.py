"""Style and script of the report: they stand in the page, which loads nothing."""

from __future__ import annotations

from scm_world.discovery.exam.side_by_side import VERDICTS

_STYLE = """
body{margin:0 auto;padding:0 20px 40px;max-width:1720px;font:15px/1.45 sans-serif;color:#222;
background:#fff}
h1{font-size:26px;margin:18px 0 4px}
h2{font-size:20px;margin:34px 0 6px;border-top:2px solid #c9ced6;
padding-top:12px}h3{font-size:16px;margin:22px 0 2px}p{margin:4px 0;max-width:75em}
nav ul,.legend{list-style:none;padding:0;margin:6px 0;display:flex;flex-wrap:wrap;gap:2px 22px}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:13px;margin:8px 0}
th,td{padding:3px 9px;border-bottom:1px solid #dde1e7;text-align:right;white-space:nowrap}
th{position:relative;vertical-align:bottom;border-bottom:2px solid #6b7686}
td.l,th.l{text-align:left}td.w{white-space:normal;text-align:left;min-width:24em}
th button{font:inherit;font-weight:bold;
border:0;background:none;padding:0;cursor:pointer;color:#222}
th[aria-sort=ascending] button::after{content:" ▲"}
th[aria-sort=descending] button::after{content:" ▼"}
td.best{font-weight:bold;background:#eef5fb}
.pair{display:flex;flex-wrap:wrap;gap:14px;align-items:flex-start}
figure{margin:4px 0;min-width:0}
.pair figure{border:1px solid #dde1e7;padding:6px;box-sizing:border-box}
figcaption{font-size:13px;color:#4a5568}img{max-width:100%;height:auto}
output{display:block;min-height:1.4em;font-size:13px}
details{margin:4px 0}summary{cursor:pointer}.none{padding:30px;background:#f4f5f7;max-width:40em}
dl{display:grid;grid-template-columns:max-content 1fr;gap:2px 14px;font-size:13px}dd{margin:0;
overflow-wrap:anywhere}
svg.shared{position:absolute}svg.graph{display:block;max-width:100%;height:auto}
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
:focus-visible{outline:3px solid #0072B2;outline-offset:2px}
@media print{nav,output{display:none}body{max-width:none}.pair,tr{break-inside:avoid}}
"""

SCRIPT = """
for(const table of document.querySelectorAll("table.sort")){
  const heads=[...table.tHead.rows[0].cells],body=table.tBodies[0];
  heads.forEach((head,i)=>{
    const button=document.createElement("button");button.type="button";
    button.textContent=head.textContent;head.replaceChildren(button);
    button.addEventListener("click",()=>{
      const down=head.getAttribute("aria-sort")==="ascending",sign=down?-1:1;
      heads.forEach(other=>other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort",down?"descending":"ascending");
      const key=row=>row.cells[i].dataset.v??row.cells[i].textContent;
      const order=(one,other)=>{const a=key(one),b=key(other);
        if(a===""||b==="")return (a==="")-(b==="");
        return sign*(isNaN(a)||isNaN(b)?a.localeCompare(b):a-b)};
      body.append(...[...body.rows].sort(order))})})}
for(const svg of document.querySelectorAll("svg.found")){
  const edges=[...svg.querySelectorAll(".e")],say=svg.parentNode.querySelector("output");let at=-1;
  const show=i=>{edges[at]?.classList.remove("hot");at=i;edges[i]?.classList.add("hot");
    say.textContent=edges[i]?.querySelector("title")?.textContent??""};
  svg.addEventListener("pointerover",e=>show(edges.indexOf(e.target.closest(".e"))));
  svg.addEventListener("blur",()=>show(-1));
  svg.addEventListener("keydown",e=>{const step={ArrowRight:1,ArrowLeft:-1}[e.key];
    if(step&&edges.length){e.preventDefault();show((at+step+edges.length)%edges.length)}})}
addEventListener("beforeprint",()=>{
  for(const part of document.querySelectorAll("details"))part.open=true});
"""


def style() -> str:
    """Write the style, with the looks of the verdicts."""
    lines = "".join(
        f".{v.name}{{stroke:{v.color};stroke-width:{v.width};stroke-dasharray:{v.dashes};"
        f"marker-end:url(#tip-{v.name})}}"
        f".t-{v.name}{{color:{v.color};fill:{v.color}}}\n"
        for v in VERDICTS
    )
    return f"{lines}{_STYLE}"
