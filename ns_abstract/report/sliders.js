// A slider with a text above it. Shared by the pages: what they show differs, how one moves through it does not.
"use strict";

// steps: the last position; told: gives the text; moved: is told every new position before the text is asked for.
function textSlider(id, steps, position, told, moved) {
  const label = document.createElement("label"), text = document.createElement("span"), range = document.createElement("input");
  const say = () => { text.textContent = told(); };
  Object.assign(range, { type: "range", min: 0, max: steps, step: 1 });
  range.id = id;
  range.value = position;
  range.addEventListener("input", () => { moved(Number(range.value)); say(); });
  say();
  label.append(text, range);
  return label;
}
