// Tells about the cell of a certificate that is chosen in the map of verdicts. Nothing is loaded.
"use strict";
(() => {
  const place = document.getElementById("cell"), source = document.getElementById("cell-data");
  if (!place || !source) return;
  const { parameters, cells, pictures } = JSON.parse(source.textContent);
  const get = (id) => document.getElementById(id);
  const shortNumber = (v) => (v === null ? "–" : Number(v.toPrecision(5)).toString());
  let chosen = -1;

  function row(body, name, text) {
    const line = document.createElement("tr");
    [name, text].forEach((content) => {
      const cell = document.createElement("td");
      cell.className = "left";
      cell.textContent = content;
      line.append(cell);
    });
    body.append(line);
  }

  function show(number) {
    const cell = cells[number];
    if (!cell) return;
    for (const shape of document.querySelectorAll("[data-cell].chosen")) shape.classList.remove("chosen");
    for (const shape of document.querySelectorAll('[data-cell="' + number + '"]')) shape.classList.add("chosen");
    chosen = number;
    const [frame, verdict, lower, upper, margin, example, picture] = cell;
    get("cell-title").textContent = verdict + ", frame " + frame;
    get("cell-title").className = verdict + "-ink";
    const body = get("cell-values");
    body.replaceChildren();
    parameters.forEach(([name, unit], k) => {
      if (lower[k] < upper[k]) row(body, name, "[" + shortNumber(lower[k]) + ", " + shortNumber(upper[k]) + "] " + unit);
    });
    if (verdict === "certified") row(body, "margin", "at least " + shortNumber(margin));
    else if (margin !== null) row(body, "margin", shortNumber(margin));
    if (example) row(body, "counterexample", parameters.map(([name, unit], k) => name + " = " + shortNumber(example[k]) + " " + unit).join(", "));
    const image = get("cell-picture"), entry = picture === null ? null : pictures[picture];
    image.hidden = !entry;
    if (entry) image.src = entry[0];
    get("cell-caption").textContent = entry ? entry[1] : "No picture of this cell is in the page.";
    place.hidden = false;
    place.dataset.cell = String(number);
  }

  document.addEventListener("click", (event) => {
    const shape = event.target.closest ? event.target.closest("[data-cell]") : null;
    if (shape) show(Number(shape.dataset.cell));
  });
  get("cell-before").addEventListener("click", () => show(Math.max(0, chosen - 1)));
  get("cell-next").addEventListener("click", () => show(Math.min(cells.length - 1, chosen + 1)));
  get("cell-hint").hidden = false;
})();
