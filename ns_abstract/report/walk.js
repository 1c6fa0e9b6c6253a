// Shows the pictures along a set one at a time, as a slider stands; without it they all stand side by side.
"use strict";
(() => {
  const place = document.getElementById("walk");
  if (!place) return;
  const figures = [...place.querySelectorAll("figure")], marks = [...document.getElementById("walk-verdicts").children];
  let at = 0;

  function show(position) {
    at = position;
    figures.forEach((figure, k) => { figure.hidden = k !== at; });
    marks.forEach((mark, k) => mark.classList.toggle("here", k === at));
  }

  // it begins where something is certified
  show(Math.max(0, marks.findIndex((mark) => mark.className === "certified-back")));
  const told = () => at + 1 + " of " + figures.length + ": " + figures[at].dataset.at;
  document.getElementById("walk-control").append(textSlider("walk-slider", figures.length - 1, at, told, show));
  place.classList.add("moves");
})();
