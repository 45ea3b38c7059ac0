'use strict';
// Two pictures on canvases: the profile of now, and target, stations and next pose in space.

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue('--' + name).trim();
}

function board(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext('2d');
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = '12px system-ui, sans-serif';
  return { pen, width, height };
}

function box(points) {
  const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  for (const p of points) for (const k of [0, 1]) {
    low[k] = Math.min(low[k], p[k]);
    high[k] = Math.max(high[k], p[k]);
  }
  return { low, high };
}

// Lines every 1, 2 or 5 times a power of ten millimetres, at least 40 pixels apart.
function grid(pen, width, height, place, scale) {
  const least = 40 / scale, power = 10 ** Math.floor(Math.log10(least));
  const step = [1, 2, 5, 10].map(k => k * power).find(s => s >= least);
  const digits = Math.max(0, -Math.floor(Math.log10(step * 1e3)));
  const [x0, z0] = place([0, 0]);
  pen.strokeStyle = colour('line');
  pen.fillStyle = colour('dim');
  pen.lineWidth = 1;
  pen.beginPath();
  for (let k = Math.ceil(-x0 / scale / step); x0 + k * step * scale < width; k++) {
    const x = x0 + k * step * scale;
    pen.moveTo(x, 0);
    pen.lineTo(x, height);
    pen.fillText((1e3 * k * step).toFixed(digits), x + 2, height - 4);
  }
  for (let k = Math.ceil(-z0 / scale / step); z0 + k * step * scale < height; k++) {
    const z = z0 + k * step * scale;
    pen.moveTo(0, z);
    pen.lineTo(width, z);
    pen.fillText((1e3 * k * step).toFixed(digits) + ' mm', 2, z - 2);
  }
  pen.stroke();
}

let frame = null;  // of the profiles seen so far, so that the picture does not jump

function drawProfile(canvas, profile) {
  const { pen, width, height } = board(canvas);
  if (!profile || !profile.points.length) {
    pen.fillStyle = colour('dim');
    pen.fillText('no profile with a return', 12, height / 2);
    return;
  }
  const now = box(profile.points);
  frame = frame ? { low: frame.low.map((v, k) => Math.min(v, now.low[k])),
    high: frame.high.map((v, k) => Math.max(v, now.high[k])) } : now;
  // one scale for both axes: what is square is shown square
  const edge = 26, size = [0, 1].map(k => Math.max(frame.high[k] - frame.low[k], 1e-6));
  const scale = Math.min((width - 2 * edge) / size[0], (height - 2 * edge) / size[1]);
  const middle = [0, 1].map(k => (frame.low[k] + frame.high[k]) / 2);
  const place = p => [width / 2 + (p[0] - middle[0]) * scale, height / 2 + (p[1] - middle[1]) * scale];
  grid(pen, width, height, place, scale);
  pen.fillStyle = colour('text');
  for (const p of profile.points) {
    const [x, y] = place(p);
    pen.fillRect(x - 1, y - 1, 2, 2);
  }
  pen.strokeStyle = colour('main');
  pen.lineWidth = 3;
  for (const line of profile.lines) stroke(pen, line.map(place));
  pen.fillStyle = colour('aim');
  for (const spot of profile.spots) dot(pen, place(spot), 6);
}

function stroke(pen, points) {
  pen.beginPath();
  points.forEach((p, i) => (i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])));
  pen.stroke();
}

function dot(pen, p, radius) {
  pen.beginPath();
  pen.arc(p[0], p[1], radius, 0, 2 * Math.PI);
  pen.fill();
}

const eye = { turn: 0.7, lift: 0.5 };

function turned(p) {
  const c = Math.cos(eye.turn), s = Math.sin(eye.turn);
  const x = c * p[0] - s * p[1], y = s * p[0] + c * p[1];
  return [x, -(Math.cos(eye.lift) * p[2] + Math.sin(eye.lift) * y)];
}

const ahead = (p, way, length) => p.map((v, k) => v + length * way[k]);

function drawScene(canvas, scene) {
  const { pen, width, height } = board(canvas);
  const at = s => s.sensor || s.flange;
  const all = [...scene.stations.map(at), ...(scene.next ? [at(scene.next)] : []),
    ...scene.edges.flat(), ...scene.outline.flat(), ...(scene.spots || [])];
  if (!all.length) {
    pen.fillStyle = colour('dim');
    pen.fillText('no samples yet', 12, height / 2);
    return;
  }
  const bounds = box(all.map(turned)), edge = 24;
  const size = [0, 1].map(k => Math.max(bounds.high[k] - bounds.low[k], 1e-3));
  const scale = Math.min((width - 2 * edge) / size[0], (height - 2 * edge) / size[1]);
  const flat = p => {
    const q = turned(p);
    return [0, 1].map(k => (k ? height : width) / 2
      + scale * (q[k] - (bounds.low[k] + bounds.high[k]) / 2));
  };
  pen.strokeStyle = pen.fillStyle = colour('good');
  pen.lineWidth = 1;
  for (const line of scene.outline) stroke(pen, line.map(flat));
  pen.lineWidth = 3;
  for (const line of scene.edges) stroke(pen, line.map(flat));
  for (const spot of scene.spots || []) dot(pen, flat(spot), 2);
  const station = (s, name, radius, text) => {
    pen.strokeStyle = pen.fillStyle = colour(name);
    pen.lineWidth = name === 'aim' ? 3 : 1;
    if (s.looks) stroke(pen, [flat(at(s)), flat(ahead(at(s), s.looks, 0.05))]);
    const p = flat(at(s));
    dot(pen, p, radius);
    if (text) pen.fillText(text, p[0] + radius + 2, p[1] - 2);
  };
  for (const s of scene.stations) station(s, 'main', 4, String(s.number));
  if (scene.next) station(scene.next, 'aim', 7, 'next');
}

function turnable(canvas, redraw) {
  let last = null;
  canvas.addEventListener('pointerdown', event => {
    last = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener('pointermove', event => {
    if (!last) return;
    eye.turn += (event.clientX - last[0]) * 0.01;
    eye.lift = Math.min(1.5, Math.max(-0.2, eye.lift + (event.clientY - last[1]) * 0.01));
    last = [event.clientX, event.clientY];
    redraw();
  });
  for (const name of ['pointerup', 'pointercancel']) {
    canvas.addEventListener(name, () => { last = null; });
  }
}
