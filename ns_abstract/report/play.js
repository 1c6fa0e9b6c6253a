// Shows a frame's bounds at any pose of its set. Nothing is loaded: the numbers stand in the page.
"use strict";
(() => {
  const place = document.getElementById("play");
  const texts = [...document.querySelectorAll("script.play-data")];
  if (!place || !texts.length || typeof DecompressionStream === "undefined") return;
  const get = (id) => document.getElementById(id);
  const colors = place.dataset.colors.match(/../g).map((h) => parseInt(h, 16));
  const types = { u1: Uint8Array, u2: Uint16Array, i1: Int8Array, i2: Int16Array, i4: Int32Array, f4: Float32Array, f8: Float64Array };
  const frames = new Map();
  let frame = null, shown = "lower", pixel = null, pinned = false;

  // a JSON line and arrays, bytes of one rank together (report/play.py)
  async function read(text) {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    const end = bytes.indexOf(10);
    const found = JSON.parse(new TextDecoder().decode(bytes.subarray(0, end)));
    let at = end + 1;
    for (const { name, type, shape } of found.arrays) {
      const size = Number(type.slice(-1)), count = shape.reduce((a, b) => a * b, 1);
      const whole = new Uint8Array(count * size);
      for (let k = 0; k < size; k++) for (let i = 0; i < count; i++) whole[i * size + k] = bytes[at + k * count + i];
      at += count * size;
      found[name] = new types[type.slice(-2)](whole.buffer);
      if (name === "slope") found.side = shape[shape.length - 1];
    }
    prepare(found);
    return found;
  }

  // every number stands as a difference from a guess, modulo its type (report/play.py)
  function prepare(f) {
    f.d = f.names.length;
    f.step = 1 / f.steps;
    f.pose = f.ends.map(([a, b]) => 0.5 * (a + b));
    f.cells = Boolean(f.slope) && f.d > 0;
    const row = 3 * f.width, size = row * f.height;
    for (let i = 0; i < size; i++) {
      if (i % row > 2) { f.lower[i] += f.lower[i - 3]; f.image[i] += f.image[i - 3]; }
      f.upper[i] += f.lower[i];
      f.witness_lower[i] += f.lower[i];
      f.witness_upper[i] += f.upper[i];
    }
    if (f.view_images) for (let i = size; i < f.view_images.length; i++) f.view_images[i] += f.view_images[i - size];
    if (!f.cells) return;
    const side = f.side, one = 3 * side * side;
    f.tiles = new Map();
    for (let l = 0; l < f.tile.length / 2; l++) {
      const key = f.tile[2 * l] + "," + f.tile[2 * l + 1], o = l * one, s = o * f.d;
      const follows = f.d === 1 && f.tiles.has(key);
      for (let i = 0; i < one * f.d; i++) {
        if (follows) f.slope[s + i] += f.slope[s + i - one];
        else if (i % side) f.slope[s + i] += f.slope[s + i - 1];
        f.slope_more[s + i] += f.slope[s + i];
      }
      for (let i = 0; i < one; i++) {
        if (follows) f.offset[o + i] += f.offset[o + i - one] + f.slope[s + i] + f.slope[s + i - one];
        else if (i % side) f.offset[o + i] += f.offset[o + i - 1];
        f.offset_more[o + i] += f.offset[o + i];
      }
      if (!f.tiles.has(key)) f.tiles.set(key, []);
      f.tiles.get(key).push(l);
    }
  }

  // the leaf of a tile that holds a pose, and the pose scaled to [-1, 1]
  function leafAt(f, leaves, pose) {
    for (const l of leaves) {
      let inside = true;
      for (let k = 0; k < f.d; k++) inside &&= pose[k] >= f.box_lower[l * f.d + k] && pose[k] <= f.box_upper[l * f.d + k];
      if (!inside) continue;
      const scaled = new Float64Array(f.d);
      for (let k = 0; k < f.d; k++) {
        const a = f.box_lower[l * f.d + k], b = f.box_upper[l * f.d + k];
        scaled[k] = b > a ? (2 * (pose[k] - a)) / (b - a) - 1 : 0;
      }
      return { leaf: l, scaled };
    }
    return null;
  }

  // lower and upper bound of one number of a leaf, in steps, rounded outward
  function value(f, { leaf, scaled }, channel, spot, n) {
    const area = f.side * f.side, o = (leaf * 3 + channel) * area + spot;
    let low = f.offset[o], top = f.offset_more[o];
    for (let k = 0; k < f.d; k++) {
      const s = ((leaf * f.d + k) * 3 + channel) * area + spot;
      low += f.slope[s] * scaled[k];
      top += f.slope_more[s] * scaled[k];
    }
    low *= f.steps / f.cell_steps; top *= f.steps / f.cell_steps;
    // what holds on the whole set holds here
    return [Math.max(Math.floor(low), f.lower[n]), Math.min(Math.ceil(top), f.upper[n])];
  }

  function evaluate(f) {
    if (!f.cells || get("play-whole").checked) { f.now = { lower: f.lower, upper: f.upper }; return; }
    const lower = f.lower.slice(), upper = f.upper.slice();
    for (const [key, leaves] of f.tiles) {
      const found = leafAt(f, leaves, f.pose);
      if (!found) continue;
      const [top, left] = key.split(",").map(Number);
      for (let r = 0; r < f.side && top + r < f.height; r++)
        for (let c = 0; c < f.side && left + c < f.width; c++)
          for (let ch = 0; ch < 3; ch++) {
            const n = ((top + r) * f.width + left + c) * 3 + ch;
            [lower[n], upper[n]] = value(f, found, ch, r * f.side + c, n);
          }
    }
    f.now = { lower, upper };
  }

  const length = (f, a, b, i) =>
    f.step * Math.hypot(b[i] - a[i], b[i + 1] - a[i + 1], b[i + 2] - a[i + 2]);

  function widest(f, a, b) {
    let most = 0;
    for (let i = 0; i < f.height * f.width; i++) most = Math.max(most, length(f, a, b, 3 * i));
    return most;
  }

  // the rendered pose that is nearest, each parameter measured by its range
  function nearest(f) {
    if (!f.view_values || get("play-whole").checked) return -1;
    let best = -1, least = Infinity;
    for (let v = 0; v < f.view_values.length / f.d; v++) {
      let sum = 0;
      for (let k = 0; k < f.d; k++) sum += ((f.view_values[v * f.d + k] - f.pose[k]) / (f.ends[k][1] - f.ends[k][0])) ** 2;
      if (sum < least) { least = sum; best = v; }
    }
    return best;
  }

  function draw() {
    const f = frame, canvas = get("play-picture"), size = f.height * f.width;
    evaluate(f);
    canvas.width = f.width; canvas.height = f.height;
    const context = canvas.getContext("2d"), picture = context.createImageData(f.width, f.height), out = picture.data;
    const { lower, upper } = f.now, view = nearest(f);
    const gaps = shown === "gap" ? [lower, upper] : [f.witness_lower, f.witness_upper];
    // renders on the scale of the set's bounds, the gap on its own
    f.scale = shown === "gap" ? widest(f, lower, upper) : f.largest;
    for (let i = 0; i < size; i++) {
      for (let ch = 0; ch < 3; ch++) {
        const n = 3 * i + ch;
        let v = 0;
        // down to 8 bits: bounds outward
        if (shown === "lower") v = Math.floor(lower[n] * f.step * 255 + 1e-9);
        else if (shown === "upper") v = Math.ceil(upper[n] * f.step * 255 - 1e-9);
        else if (shown === "image") v = view < 0 ? f.image[n] : f.view_images[view * 3 * size + n];
        else v = colors[3 * Math.min(255, Math.floor((length(f, ...gaps, 3 * i) / (f.scale || 1)) * 255)) + ch];
        out[4 * i + ch] = v;
      }
      out[4 * i + 3] = 255;
    }
    context.putImageData(picture, 0, 0);
    get("play-caption").textContent = caption(view);
    tell();
  }

  const shortNumber = (v) => Number(v.toPrecision(4)).toString();
  const poseText = (values) => frame.names.map((n, k) => n + " = " + shortNumber(values[k]) + " " + frame.units[k]).join(", ");

  function caption(view) {
    const whole = !frame.cells || get("play-whole").checked, where = whole ? "any pose of the set" : "this pose";
    let sum = 0;
    for (let i = 0; i < frame.height * frame.width; i++) sum += length(frame, frame.now.lower, frame.now.upper, 3 * i);
    const mean = "Mean pixel gap " + shortNumber(whole ? frame.mpg : sum / (frame.height * frame.width));
    if (shown === "lower") return "No picture of " + where + " is darker. " + mean;
    if (shown === "upper") return "No picture of " + where + " is brighter. " + mean;
    if (shown === "gap") return "Length over RGB of upper − lower, over " + where + "; the brightest colour is " + shortNumber(frame.scale) + ". " + mean;
    if (shown === "witness") return "The same of pictures of the set that were really rendered; the brightest colour is " + shortNumber(frame.scale) + ".";
    if (view < 0) return "One render, at the middle of the set.";
    return "The nearest render: " + poseText([...frame.view_values.slice(view * frame.d, (view + 1) * frame.d)]);
  }

  // the pixel under the pointer
  function tell() {
    const body = get("play-values"), f = frame;
    get("play-table").hidden = !pixel;
    body.replaceChildren();
    get("play-where").textContent = pixel ? "row " + pixel[0] + ", column " + pixel[1] + (pinned ? " (held)" : "") : "point at the picture; click to hold a pixel";
    if (!pixel) { curve(); return; }
    const digits = Math.round(Math.log10(f.steps));
    ["red", "green", "blue"].forEach((name, ch) => {
      const n = (pixel[0] * f.width + pixel[1]) * 3 + ch, row = document.createElement("tr");
      const cells = [f.now.lower, f.now.upper, f.witness_lower, f.witness_upper].map((a) => (a[n] * f.step).toFixed(digits));
      [name, ...cells].forEach((text) => {
        const cell = document.createElement("td");
        cell.textContent = text;
        row.append(cell);
      });
      body.append(row);
    });
    curve();
  }

  // bounds of the pixel over one parameter, the others as the sliders stand
  function curve() {
    const canvas = get("play-curve"), f = frame, plot = canvas.getContext("2d");
    const width = canvas.width, height = canvas.height, left = 44, right = width - 10, bottom = height - 34, high = 12;
    plot.clearRect(0, 0, width, height);
    canvas.hidden = !(pixel && f.cells);
    get("play-axis-label").hidden = canvas.hidden || f.d < 2;
    if (canvas.hidden) return;
    const axis = Number(get("play-axis").value) || 0, [from, to] = f.ends[axis], count = 160;
    const [row, column] = pixel, top = row - (row % f.side), across = column - (column % f.side);
    const leaves = f.tiles.get(top + "," + across) || [], spot = (row - top) * f.side + column - across;
    const lines = [[], [], []];
    let least = Infinity, most = -Infinity;
    for (let s = 0; s <= count; s++) {
      const pose = f.pose.slice();
      pose[axis] = from + ((to - from) * s) / count;
      const found = leafAt(f, leaves, pose);
      for (let ch = 0; ch < 3; ch++) {
        const n = (row * f.width + column) * 3 + ch;
        const pair = found ? value(f, found, ch, spot, n) : [f.lower[n], f.upper[n]];
        lines[ch].push(pair);
        least = Math.min(least, pair[0]); most = Math.max(most, pair[1]);
      }
    }
    const room = Math.max(2, 0.06 * (most - least));
    least -= room; most += room;
    const x = (v) => left + ((v - from) / (to - from)) * (right - left);
    const y = (v) => bottom - ((v - least) / (most - least)) * (bottom - high);
    const style = getComputedStyle(document.documentElement), ink = style.getPropertyValue("--soft");
    plot.font = "11px sans-serif"; plot.fillStyle = ink; plot.strokeStyle = style.getPropertyValue("--line");
    for (let t = 0; t <= 4; t++) {
      const v = least + ((most - least) * t) / 4;
      plot.beginPath(); plot.moveTo(left, y(v)); plot.lineTo(right, y(v)); plot.stroke();
      plot.textAlign = "right"; plot.fillText((v * f.step).toFixed(3), left - 5, y(v) + 4);
      const at = from + ((to - from) * t) / 4;
      plot.textAlign = t === 0 ? "left" : t === 4 ? "right" : "center"; plot.fillText(shortNumber(at), x(at), bottom + 14);
    }
    plot.textAlign = "center";
    plot.fillText(f.names[axis] + " (" + f.units[axis] + ")", 0.5 * (left + right), height - 6);
    ["200, 60, 50", "40, 150, 80", "50, 110, 210"].forEach((rgb, ch) => {
      plot.beginPath();
      lines[ch].forEach(([a], s) => plot.lineTo(x(from + ((to - from) * s) / count), y(a)));
      lines[ch].slice().reverse().forEach(([, b], s) => plot.lineTo(x(to - ((to - from) * s) / count), y(b)));
      plot.closePath();
      plot.fillStyle = "rgba(" + rgb + ", 0.28)"; plot.strokeStyle = "rgb(" + rgb + ")"; plot.fill(); plot.stroke();
      for (let v = 0; f.view_values && v < f.view_values.length / f.d; v++) {
        let on = true;
        for (let k = 0; k < f.d; k++) on &&= k === axis || Math.abs(f.view_values[v * f.d + k] - f.pose[k]) < 1e-3 * (f.ends[k][1] - f.ends[k][0]);
        if (!on) continue;
        const n = (v * f.height * f.width + row * f.width + column) * 3 + ch;
        plot.beginPath();
        plot.arc(x(f.view_values[v * f.d + axis]), y(f.view_images[n] / 255 / f.step), 2.5, 0, 7);
        plot.fillStyle = "rgb(" + rgb + ")"; plot.fill();
      }
    });
    plot.strokeStyle = ink; plot.setLineDash([4, 4]);
    plot.beginPath(); plot.moveTo(x(f.pose[axis]), high); plot.lineTo(x(f.pose[axis]), bottom); plot.stroke();
    plot.setLineDash([]);
  }

  function sliders() {
    const box = get("play-sliders"), f = frame, choice = get("play-axis");
    box.replaceChildren(); choice.replaceChildren();
    get("play-pose").hidden = !f.cells;
    get("play-none").hidden = f.cells || f.d === 0;
    if (!f.cells) return;
    f.names.forEach((name, k) => {
      const [from, to] = f.ends[k], told = () => name + " " + shortNumber(f.pose[k]) + " " + f.units[k];
      box.append(textSlider("play-slider-" + k, 1000, Math.round((1000 * (f.pose[k] - from)) / (to - from)), told, (position) => {
        f.pose[k] = Math.min(to, Math.max(from, from + ((to - from) * position) / 1000));
        get("play-whole").checked = false;
        draw();
      }));
      const option = document.createElement("option");
      option.value = String(k); option.textContent = name;
      choice.append(option);
    });
  }

  async function show(position) {
    if (!frames.has(position)) frames.set(position, await read(texts[position].textContent));
    frame = frames.get(position);
    if (pixel && (pixel[0] >= frame.height || pixel[1] >= frame.width)) pixel = null;
    frame.largest = widest(frame, frame.lower, frame.upper);
    sliders();
    draw();
    place.dataset.ready = String(frame.index);
  }

  const canvas = get("play-picture");
  const under = (event) => {
    const r = canvas.getBoundingClientRect();
    const row = Math.floor(((event.clientY - r.top) / r.height) * frame.height);
    const column = Math.floor(((event.clientX - r.left) / r.width) * frame.width);
    return [Math.min(frame.height - 1, Math.max(0, row)), Math.min(frame.width - 1, Math.max(0, column))];
  };
  canvas.addEventListener("pointermove", (event) => { if (frame && !pinned) { pixel = under(event); tell(); } });
  canvas.addEventListener("pointerleave", () => { if (frame && !pinned) { pixel = null; tell(); } });
  canvas.addEventListener("click", (event) => {
    const next = under(event);
    pinned = !(pinned && pixel && next[0] === pixel[0] && next[1] === pixel[1]);
    pixel = next;
    tell();
  });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
    if (!frame || !step) return;
    event.preventDefault();
    const [row, column] = pixel || [0, 0];
    pixel = [Math.min(frame.height - 1, Math.max(0, row + step[0])), Math.min(frame.width - 1, Math.max(0, column + step[1]))];
    pinned = true;
    tell();
  });
  for (const button of place.querySelectorAll("input[name=play-shown]"))
    button.addEventListener("change", () => { shown = button.value; draw(); });
  get("play-whole").addEventListener("change", draw);
  get("play-axis").addEventListener("change", tell);
  get("play-frame").addEventListener("change", (event) => show(Number(event.target.value)));
  place.hidden = false;
  show(0);
})();
