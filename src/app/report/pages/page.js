"use strict";
// A click on a column title sorts ascending by that column, a second click descending. The address
// then links to the sorted table: #sort=TABLE/COLUMN, descending #sort=TABLE/-COLUMN.
function sort(head, up) {
  const body = head.closest("table").tBodies[0];
  const column = head.cellIndex;
  for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  const key = (row) => {
    const cell = row.cells[column];
    const number = Number(cell.dataset.value ?? NaN);
    return Number.isFinite(number) ? number : cell.textContent;
  };
  const before = (a, b) => {
    const [x, y] = [key(a), key(b)];
    // Cells without a number come last.
    if (typeof x !== typeof y) return typeof x === "number" ? -1 : 1;
    const order = typeof x === "number" ? x - y : x.localeCompare(y, "en", { numeric: true });
    return up ? order : -order;
  };
  body.append(...[...body.rows].sort(before));
}
for (const head of document.querySelectorAll("th")) {
  head.querySelector("button").addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") !== "ascending";
    sort(head, up);
    const address = `#sort=${head.closest("table").id}/${up ? "" : "-"}${head.cellIndex + 1}`;
    history.replaceState(null, "", address);
  });
}
function follow() {
  const [, id, down, column] = location.hash.match(/^#sort=(\w+)\/(-?)(\d+)$/) ?? [];
  const table = id && document.getElementById(id);
  const head = table && table.tHead.rows[0].cells[column - 1];
  if (!head) return;
  sort(head, !down);
  const folded = table.closest("details");
  if (folded) folded.open = true;
  table.scrollIntoView();
}
addEventListener("hashchange", follow);
follow();
// Collapsed texts are expanded for printing.
addEventListener("beforeprint", () => {
  for (const folded of document.querySelectorAll("details")) folded.open = true;
});
