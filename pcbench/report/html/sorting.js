// A click on the head of a column sorts the rows without a title, a second click the other way; texts without number last.
"use strict";
const numberOf = (text) => {
  const value = parseFloat(text.replaceAll(",", ""));
  return /^[-+\u2212]?[\d.]/.test(text) && !Number.isNaN(value) ? value : null;
};
const compare = (one, other, sign) => {
  const [a, b] = [numberOf(one), numberOf(other)];
  if (a === null && b === null) return sign * one.localeCompare(other, undefined, { numeric: true });
  return a === null || b === null ? (a === null) - (b === null) : sign * (a - b);
};
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.title = "Sort by this column";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
      heads.forEach((each) => each.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
      for (const body of table.tBodies) {
        if (body.querySelector("th.group")) continue;
        const text = (row) => row.cells[column].textContent.trim();
        body.append(...[...body.rows].sort((one, other) => compare(text(one), text(other), sign)));
      }
    });
  });
}
