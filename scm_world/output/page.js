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
