/* Copyright 2026 The handeye_ros developers. SPDX-License-Identifier: Apache-2.0 */
'use strict';
// Draws in space on a canvas, and turns it: for the page and for the report. No library, as there are
// lines, faces and points only.

const HOME = { turn: 0.7, lift: 0.45, zoom: 1 };
const eye = { ...HOME };

const add = (a, b, k = 1) => a.map((v, i) => v + k * b[i]);
const column = (T, j) => [0, 1, 2].map(i => T[i][j]);
const at = (T, p) => [0, 1, 2].map(i =>
  T[i][0] * p[0] + T[i][1] * p[1] + T[i][2] * p[2] + T[i][3]);

// Where points are on the canvas: all of them fit in it.
function camera(points, width, height) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const p of points) for (const k of [0, 1, 2]) {
    low[k] = Math.min(low[k], p[k]);
    high[k] = Math.max(high[k], p[k]);
  }
  const middle = low.map((v, k) => (v + high[k]) / 2);
  const radius = Math.max(0.05, Math.hypot(...high.map((v, k) => v - low[k])) / 2);
  const c = Math.cos(eye.turn), s = Math.sin(eye.turn);
  const cl = Math.cos(eye.lift), sl = Math.sin(eye.lift);
  const turned = p => {
    const [x, y, z] = add(p, middle, -1);
    const across = c * x - s * y, along = s * x + c * y;
    return [across, cl * z + sl * along, cl * along - sl * z];  // right, up, away
  };
  const far = 4 * radius, edge = 26;
  const flat = points.map(p => {
    const [x, y, away] = turned(p);
    return [x / (far + away), y / (far + away)];
  });
  const bounds = box(flat);
  const scale = eye.zoom * Math.min((width - 2 * edge) / (bounds.high[0] - bounds.low[0] || 1e-6),
    (height - 2 * edge) / (bounds.high[1] - bounds.low[1] || 1e-6), 1.2 * width * 2);
  const shift = [0, 1].map(k => (bounds.low[k] + bounds.high[k]) / 2);
  return p => {
    const [x, y, away] = turned(p);
    return [width / 2 + scale * (x / (far + away) - shift[0]),
      height / 2 - scale * (y / (far + away) - shift[1]), away, scale / (far + away)];
  };
}

// What is drawn, from the farthest to the nearest; labels come last and keep off each other.
class Drawing {
  constructor(pen, flat, width, height) {
    Object.assign(this, { pen, flat, width, height, parts: [], labels: [] });
  }

  part(points, draw, nearer = 0) {
    const placed = points.map(this.flat);
    const away = placed.reduce((sum, p) => sum + p[2], 0) / placed.length - nearer;
    this.parts.push([away, () => draw(placed)]);
  }

  line(points, name, width, dash = []) {
    for (let i = 1; i < points.length; i++) {
      this.part([points[i - 1], points[i]], placed => {
        this.pen.strokeStyle = colour(name);
        this.pen.lineWidth = width;
        this.pen.setLineDash(dash);
        stroke(this.pen, placed);
        this.pen.setLineDash([]);
      });
    }
  }

  face(points, name, alpha, outline = true) {
    this.part(points, placed => {
      this.pen.beginPath();
      placed.forEach(([x, y], i) => (i ? this.pen.lineTo(x, y) : this.pen.moveTo(x, y)));
      this.pen.closePath();
      this.pen.globalAlpha = alpha;
      this.pen.fillStyle = colour(name);
      this.pen.fill();
      this.pen.globalAlpha = 1;
      if (!outline) return;
      this.pen.strokeStyle = colour(name);
      this.pen.lineWidth = 1;
      this.pen.stroke();
    });
  }

  ball(centre, radius, name) {
    this.part([centre], ([[x, y, , scale]]) => {
      const r = radius * scale, shade = this.pen.createRadialGradient(
        x - r / 3, y - r / 3, r / 8, x, y, r);
      shade.addColorStop(0, colour('card'));
      shade.addColorStop(1, colour(name));
      this.pen.globalAlpha = 0.8;
      this.pen.fillStyle = shade;
      dot(this.pen, [x, y], r);
      this.pen.globalAlpha = 1;
    });
  }

  mark(point, name, kind, words) {
    this.part([point], ([[x, y]]) => {
      this.pen.strokeStyle = this.pen.fillStyle = colour(name);
      this.pen.lineWidth = 2;
      if (kind === 'out') {
        stroke(this.pen, [[x - 5, y - 5], [x + 5, y + 5]]);
        stroke(this.pen, [[x - 5, y + 5], [x + 5, y - 5]]);
      } else dot(this.pen, [x, y], 5);
    }, 0.01);
    if (words) this.words(point, words, name);
  }

  words(point, words, name, weight = '') {
    this.labels.push({ point: this.flat(point), words, name, weight });
  }

  finish() {
    for (const [, draw] of this.parts.sort((a, b) => b[0] - a[0])) draw();
    const taken = [];
    for (const { point: [x, y], words, name, weight } of this.labels) {
      this.pen.font = `${weight} 13px system-ui, sans-serif`;
      const w = this.pen.measureText(words).width + 6, h = 17;
      const free = [[9, -8], [9, 20], [-9 - w, -8], [-9 - w, 20], [-w / 2, -16], [-w / 2, 30],
        [16, -26], [-16 - w, -26], [16, 40], [-16 - w, 40]]
        .map(([dx, dy]) => [Math.min(Math.max(x + dx, 2), this.width - w - 2),
          Math.min(Math.max(y + dy, h), this.height - 4)])
        .find(([a, b]) => taken.every(([c, d, cw]) =>
          a + w < c || c + cw < a || Math.abs(b - d) > h));
      if (!free) continue;
      const [a, b] = free;
      taken.push([a, b, w]);
      this.pen.globalAlpha = 0.75;
      this.pen.fillStyle = colour('card') || '#fff';
      this.pen.fillRect(a, b - 13, w, h);
      this.pen.globalAlpha = 1;
      this.pen.fillStyle = colour(name);
      this.pen.fillText(words, a + 3, b);
    }
  }
}

// A sensor at T: its body, and its light plane over the field of view.

// Return a colour of the style sheet by its name, or one as it is.
function colour(name) {
  if (name[0] === '#') return name;
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
  pen.font = '13px system-ui, sans-serif';
  pen.lineJoin = 'round';
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

// By mouse, touch (one finger turns, two tilt and zoom), keyboard and the buttons beside it.
function turnable(canvas, redraw) {
  const fingers = new Map();
  const change = (turn, lift, zoom = 1) => {
    eye.turn += turn;
    eye.lift = Math.min(1.55, Math.max(-0.5, eye.lift + lift));
    eye.zoom = Math.min(6, Math.max(0.4, eye.zoom * zoom));
    redraw();
  };
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  };
  canvas.addEventListener('pointerdown', event => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener('pointermove', event => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const before = fingers.size > 1 ? spread() : 0;
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const lifts = event.pointerType === 'mouse' || fingers.size > 1;
    change(0.01 * (event.clientX - last[0]) / fingers.size,
      lifts ? 0.01 * (event.clientY - last[1]) / fingers.size : 0, before ? spread() / before : 1);
  });
  for (const name of ['pointerup', 'pointercancel']) {
    canvas.addEventListener(name, event => fingers.delete(event.pointerId));
  }
  canvas.addEventListener('dblclick', () => {
    Object.assign(eye, HOME);
    redraw();
  });
  canvas.addEventListener('wheel', event => {
    if (!event.ctrlKey && document.activeElement !== canvas) return;  // the page scrolls
    event.preventDefault();
    change(0, 0, Math.exp(-0.002 * event.deltaY));
  }, { passive: false });
  const keys = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.12],
    ArrowDown: [0, -0.12], '+': [0, 0, 1.2], '-': [0, 0, 1 / 1.2] };
  canvas.addEventListener('keydown', event => {
    if (event.key === 'Home' || event.key === '0') Object.assign(eye, HOME);
    else if (!keys[event.key]) return;
    event.preventDefault();
    change(...(keys[event.key] || [0, 0]));
  });
  for (const button of document.querySelectorAll('[data-turn]')) {
    button.addEventListener('click', () => {
      const [turn, lift] = button.dataset.turn.split(',').map(Number);
      if (button.dataset.turn === 'home') Object.assign(eye, HOME);
      change(turn || 0, lift || 0);
    });
  }
}
