// Clicks on every head of every table, twice, and tells what is not sorted then.
const complaints = [];
let heads = 0;
for (const table of document.querySelectorAll("table")) {
  const body = table.tBodies[0];
  const rows = body.rows.length;
  for (const head of table.tHead.rows[0].cells) {
    heads += 1;
    const button = head.querySelector("button");
    for (const way of ["ascending", "descending"]) {
      button.scrollIntoView({ block: "center", inline: "center" });
      const box = button.getBoundingClientRect();
      const place = [box.left + box.width / 2, box.top + box.height / 2];
      const hit = document.elementFromPoint(...place);
      const name = `${table.id}/${head.textContent} ${way}`;
      if (!button.contains(hit)) complaints.push(`${name}: a finger meets something else`);
      hit?.click();
      if (head.getAttribute("aria-sort") !== way) complaints.push(`${name}: not told`);
      const cells = [...body.rows].map((row) => row.cells[head.cellIndex]);
      const numbers = cells.filter((cell) => cell.dataset.value).map((cell) => Number(cell.dataset.value));
      const sign = way === "ascending" ? 1 : -1;
      if (numbers.some((number, k) => k > 0 && sign * (number - numbers[k - 1]) < 0)) {
        complaints.push(`${name}: ${numbers.join(" ")}`);
      }
      if (cells.slice(0, numbers.length).some((cell) => !cell.dataset.value)) {
        complaints.push(`${name}: what is not measured is not last`);
      }
      if (body.rows.length !== rows) complaints.push(`${name}: rows are lost`);
      const sorted = `#sort=${table.id}/${sign < 0 ? "-" : ""}${head.cellIndex + 1}`;
      if (location.hash !== sorted) complaints.push(`${name}: the address is ${location.hash}`);
    }
  }
}
said(`${heads} heads; ${complaints.join("; ") || "all sort"}`);
