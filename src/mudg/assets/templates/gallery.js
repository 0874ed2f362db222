"use strict";
(() => {
  const table = document.getElementById("scores");
  if (!table) return;
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  const key = (row, column) => {
    const cell = row.cells[column];
    if (!cell.classList.contains("number")) return cell.textContent;
    return cell.dataset.value === "" ? null : Number(cell.dataset.value);
  };
  heads.forEach((head, column) => head.querySelector("button").addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    heads.forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down === 1 ? "ascending" : "descending");
    const rows = [...body.rows].sort((a, b) => {
      const x = key(a, column), y = key(b, column);
      if (x === null || y === null) return (x === null) - (y === null);  // rows without a number stay last
      return down * (typeof x === "number" ? x - y : x.localeCompare(y, undefined, { numeric: true }));
    });
    body.append(...rows);
  }));
  const filter = document.getElementById("filter"), place = document.getElementById("place");
  const show = () => {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean), wanted = new Set();
    for (const row of body.rows) {
      const text = [0, 1, 2].map((column) => row.cells[column].textContent.toLowerCase()).join(" ");
      const fits = words.every((word) => text.includes(word));
      row.hidden = !fits || (place.value !== "" && row.cells[3].textContent !== place.value);
      if (fits) wanted.add(row.cells[0].textContent);
    }
    for (const card of document.querySelectorAll(".cards li")) card.hidden = words.length > 0 && !wanted.has(card.dataset.run);
  };
  filter.addEventListener("input", show);
  place.addEventListener("change", show);
})();
