"""Style and script of every page: they stand in the page, which loads nothing."""

from __future__ import annotations

_FIRST = """
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
"""

_LAST = """:focus-visible{outline:3px solid #0072B2;outline-offset:2px}
@media print{nav,output{display:none}body{max-width:none}.pair,tr{break-inside:avoid}}
"""

_SORT = """
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
"""

_PRINT = """addEventListener("beforeprint",()=>{
  for(const part of document.querySelectorAll("details"))part.open=true});
"""


def style(extra: str = "", *, early: str = "") -> str:
    """Write the style of a page.

    Args:
        extra: Rules that override those of every page; each line ends.
        early: Rules that those of every page, and the extra ones, override.
    """
    return f"{early}{_FIRST}{extra}{_LAST}"


def script(extra: str = "") -> str:
    """Write the script of a page: tables of the class ``sort`` are sorted by their heads.

    Args:
        extra: Statements of its own; each line ends.
    """
    return f"{_SORT}{extra}{_PRINT}"
