// Clicks twice on every column title of every table and reports what is not sorted then.
const defects = [];
let titles = 0;
for (const table of document.querySelectorAll("table")) {
  // What is collapsed has no place to click.
  const folded = table.closest("details");
  if (folded) folded.open = true;
  const body = table.tBodies[0];
  const rows = body.rows.length;
  for (const head of table.tHead.rows[0].cells) {
    titles += 1;
    const button = head.querySelector("button");
    for (const way of ["ascending", "descending"]) {
      button.scrollIntoView({ block: "center", inline: "center" });
      const box = button.getBoundingClientRect();
      const place = [box.left + box.width / 2, box.top + box.height / 2];
      const hit = document.elementFromPoint(...place);
      const name = `${table.id}/${head.textContent} ${way}`;
      if (!button.contains(hit)) defects.push(`${name}: another element covers it`);
      hit?.click();
      if (head.getAttribute("aria-sort") !== way) defects.push(`${name}: not marked`);
      const cells = [...body.rows].map((row) => row.cells[head.cellIndex]);
      const numbers = cells.filter((cell) => cell.dataset.value).map((cell) => Number(cell.dataset.value));
      const sign = way === "ascending" ? 1 : -1;
      if (numbers.some((number, k) => k > 0 && sign * (number - numbers[k - 1]) < 0)) {
        defects.push(`${name}: ${numbers.join(" ")}`);
      }
      if (cells.slice(0, numbers.length).some((cell) => !cell.dataset.value)) {
        defects.push(`${name}: cells without a number are not last`);
      }
      if (body.rows.length !== rows) defects.push(`${name}: rows are lost`);
      const sorted = `#sort=${table.id}/${sign < 0 ? "-" : ""}${head.cellIndex + 1}`;
      if (location.hash !== sorted) defects.push(`${name}: the address is ${location.hash}`);
    }
  }
}
report(`${titles} titles; ${defects.join("; ") || "all sort"}`);
