"use strict";
// The path over the map: zoom by wheel or pinch, move by dragging, choose a frame by pointing or with the
// slider; the frame's scan is drawn where its pose puts it.
function interactive(figure) {
  const run = JSON.parse(figure.querySelector("script").textContent);
  const canvas = figure.querySelector("canvas");
  const slider = figure.querySelector("input");
  const label = figure.querySelector("output");
  const ink = canvas.getContext("2d");
  const count = run.frames.length;
  const at = (poses, k) => ({ x: poses[3 * k], y: poses[3 * k + 1], heading: poses[3 * k + 2] });
  const isTrusted = (k) => !run.trusted || run.trusted[k];
  const starts = [];
  let points = new Int16Array();
  if (run.scans) {
    const bytes = Uint8Array.from(atob(run.scans.points), (letter) => letter.charCodeAt(0));
    points = new Int16Array(bytes.buffer);
    run.scans.counts.reduce((start, points, k) => ((starts[k] = start), start + 2 * points), 0);
  }
  const largest = run.errors_cm && Math.max(...run.errors_cm, 0.01);
  const color = (k) => {
    if (run.errors_cm?.[k] == null) return run.states ? run.state_colors[run.states[k]] : run.color;
    const last = run.colormap.length - 1;
    return run.colormap[Math.min(last, Math.floor((run.errors_cm[k] / largest) * (last + 1)))];
  };
  let frame = count >> 1;
  let view; // Center [m] and pixels per metre.
  let image;

  function fit() {
    let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
    // Poses that are not trusted are no part of the path.
    const trusted = run.poses.filter((_, k) => isTrusted(Math.floor(k / 3)));
    const truth = run.truth?.filter((number) => number !== null);
    for (const poses of trusted.length ? [trusted, truth ?? []] : [truth ?? run.poses])
      for (let k = 0; k < poses.length / 3; k++) {
        const { x, y } = at(poses, k);
        [left, right] = [Math.min(left, x), Math.max(right, x)];
        [low, high] = [Math.min(low, y), Math.max(high, y)];
      }
    const [width, height] = [Math.max(right - left, 10) * 1.3, Math.max(high - low, 10) * 1.3];
    const scale = Math.min(canvas.width / width, canvas.height / height);
    view = { x: (left + right) / 2, y: (low + high) / 2, scale };
  }
  const screen = ({ x, y }) => [
    canvas.width / 2 + (x - view.x) * view.scale,
    canvas.height / 2 - (y - view.y) * view.scale,
  ];
  function trace(poses, width, style, isDrawn = () => true) {
    ink.lineWidth = width * devicePixelRatio;
    for (let k = 1; k < poses.length / 3; k++) {
      if (!isDrawn(k - 1) || !isDrawn(k)) continue;
      ink.strokeStyle = style(k);
      ink.beginPath();
      ink.moveTo(...screen(at(poses, k - 1)));
      ink.lineTo(...screen(at(poses, k)));
      ink.stroke();
    }
  }
  function draw() {
    ink.fillStyle = "#fff";
    ink.fillRect(0, 0, canvas.width, canvas.height);
    if (image) {
      const [x, y] = screen({ x: run.map.x_min, y: run.map.y_max });
      const scale = run.map.cell_m * view.scale;
      ink.drawImage(image, x, y, image.width * scale, image.height * scale);
    }
    ink.lineCap = "round";
    if (run.truth) trace(run.truth, 5, () => run.truth_color, (k) => run.truth[3 * k] !== null);
    trace(run.poses, 3, color, isTrusted);
    const pose = at(run.poses, frame);
    const [sine, cosine] = [Math.sin(pose.heading), Math.cos(pose.heading)];
    ink.fillStyle = "#c8009c";
    const size = 3.5 * devicePixelRatio;
    const start = starts[frame] ?? 0;
    for (let k = start; k < start + 2 * (run.scans?.counts[frame] ?? 0); k += 2) {
      const [forward, left] = [points[k] / 100, points[k + 1] / 100];
      const [x, y] = screen({
        x: pose.x + cosine * forward - sine * left,
        y: pose.y + sine * forward + cosine * left,
      });
      ink.fillRect(x - size / 2, y - size / 2, size, size);
    }
    const [x, y] = screen(pose);
    const arrow = (forward, left) =>
      [x + (cosine * forward - sine * left) * devicePixelRatio, y - (sine * forward + cosine * left) * devicePixelRatio];
    ink.beginPath();
    for (const corner of [[14, 0], [-8, 7], [-8, -7]]) ink.lineTo(...arrow(...corner));
    ink.closePath();
    ink.fill();
    ink.strokeStyle = "#fff";
    ink.lineWidth = 1.5 * devicePixelRatio;
    ink.stroke();
    describe();
  }
  function describe() {
    const parts = [`frame ${run.frames[frame]}`];
    if (run.times_s) parts.push(`${(run.times_s[frame] - run.times_s[0]).toFixed(1)} s`);
    if (run.states) parts.push(run.states[frame]);
    if (run.places && run.places[frame] > 1) parts.push(`one of ${run.places[frame]} places`);
    if (run.errors_cm?.[frame] != null)
      parts.push(`${run.errors_cm[frame].toFixed(1)} cm and ${run.heading_errors_deg[frame].toFixed(3)} deg off`);
    if (run.sigmas_cm) parts.push(`standard deviation ${run.sigmas_cm[frame].toFixed(1)} cm`);
    if (run.agreements && run.agreements[frame] >= 0)
      parts.push(`${(100 * run.agreements[frame]).toFixed(0)} % of the beams on the map`);
    label.textContent = parts.join(" · ");
    slider.value = frame;
  }
  function resize() {
    const width = Math.round(canvas.clientWidth * devicePixelRatio);
    if (!width || width === canvas.width) return;
    canvas.width = width;
    canvas.height = Math.round(width * (canvas.clientWidth < 500 ? 0.9 : 0.55));
    fit();
    draw();
  }
  function place(event) {
    const box = canvas.getBoundingClientRect();
    const ratio = canvas.width / box.width;
    return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
  }
  function zoom([x, y], factor) {
    const [right, up] = [(x - canvas.width / 2) / view.scale, (canvas.height / 2 - y) / view.scale];
    const scale = Math.min(Math.max(view.scale * factor, 0.01), 2000);
    const share = 1 - view.scale / scale;
    view = { x: view.x + right * share, y: view.y + up * share, scale };
    draw();
  }
  function choose([x, y]) {
    let nearest = Infinity;
    for (let k = 0; k < count; k++) {
      const [px, py] = screen(at(run.poses, k));
      const distance = Math.hypot(px - x, py - y);
      if (distance < nearest) [nearest, frame] = [distance, k];
    }
    draw();
  }
  const held = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, place(event));
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, (event) => held.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const now = place(event);
    const before = held.get(event.pointerId);
    if (!before) return choose(now);
    const others = [...held].filter(([id]) => id !== event.pointerId);
    held.set(event.pointerId, now);
    if (others.length === 1) {
      const [[, other]] = others;
      const apart = ([x, y]) => Math.max(Math.hypot(x - other[0], y - other[1]), 1);
      return zoom(other, apart(now) / apart(before));
    }
    view.x -= (now[0] - before[0]) / view.scale;
    view.y += (now[1] - before[1]) / view.scale;
    draw();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(place(event), Math.exp(-event.deltaY / 400));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => (fit(), draw()));
  slider.max = count - 1;
  slider.addEventListener("input", () => ((frame = Number(slider.value)), draw()));
  addEventListener("resize", resize);
  if (run.map) {
    const loading = new Image();
    loading.addEventListener("load", () => ((image = loading), draw()));
    loading.src = run.map.png;
  }
  resize();
}
for (const figure of document.querySelectorAll("figure.interactive")) interactive(figure);
