'use strict';
// The picture in space: sensor and light plane of now, target, samples, and the next pose.

const HOME = { turn: 0.7, lift: 0.45, zoom: 1 };
const eye = { ...HOME };
const SENSOR = [0.012, 0.02, 0.025];  // m: half sizes of the body that is drawn

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
      this.pen.fillStyle = colour('card');
      this.pen.fillRect(a, b - 13, w, h);
      this.pen.globalAlpha = 1;
      this.pen.fillStyle = colour(name);
      this.pen.fillText(words, a + 3, b);
    }
  }
}

// A sensor at T: its body, and its light plane over the field of view.
function drawSensor(drawing, T, scene, name, ghost = false) {
  const sign = scene.range_sign, [a, b, c] = SENSOR;
  const corner = (i, j, k) => at(T, [a * i, b * j, c * sign * (k - 1)]);
  const sides = [[[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]],
    [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]],
    [[-1, -1, -1], [-1, 1, -1], [-1, 1, 1], [-1, -1, 1]],
    [[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]],
    [[-1, -1, -1], [1, -1, -1], [1, -1, 1], [-1, -1, 1]],
    [[-1, 1, -1], [1, 1, -1], [1, 1, 1], [-1, 1, 1]]];
  sides.forEach((side, i) => drawing.face(side.map(p => corner(...p)), name,
    ghost ? 0.14 : [0.3, 0.5, 0.35, 0.35, 0.4, 0.4][i]));
  const view = scene.view.length ? scene.view : [[-0.03, 0.15 * sign], [0.03, 0.15 * sign]];
  const xs = view.map(p => p[0]), zs = view.map(p => p[1] * sign);
  const far = Math.max(...zs) * sign;
  const fan = [[0, 0], [Math.min(...xs), far], [Math.max(...xs), far]]
    .map(([x, z]) => at(T, [x, 0, z]));
  drawing.face(fan, ghost ? name : 'bad', ghost ? 0.06 : 0.16);
  drawing.line([fan[1], fan[2]], ghost ? name : 'bad', 1, [4, 4]);
}

function reachOf(T, scene) {
  const far = scene.view.length ? scene.view : [[0, 0.15 * scene.range_sign]];
  return [at(T, [0, 0, -2 * SENSOR[2] * scene.range_sign]), ...far.map(([x, z]) => at(T, [x, 0, z]))];
}

// state: scene, samples (by number: used, out or unused), profile, and the words of the aim
function drawScene(canvas, scene, samples, profile, words) {
  const made = board(canvas), { pen, width, height } = made;
  if (!scene.known && (scene.move || !scene.stations.length)) return drawMove(made, scene);
  const points = [...scene.stations.map(s => column(s.T, 3)), ...scene.edges.flat(),
    ...scene.outline.flat(), ...(scene.spots || [])];
  if (scene.known && scene.live) points.push(...reachOf(scene.live, scene));
  if (scene.known && scene.next) points.push(...reachOf(scene.next, scene));
  const drawing = new Drawing(pen, camera(points, width, height), width, height);
  if (scene.ball) drawing.ball(...scene.ball, 'good');
  for (const line of scene.outline) {
    if (!scene.ball && line.length > 3) drawing.face(line, 'good', 0.12);
    drawing.line(line, 'good', 1);
  }
  if (scene.edges.length === 2) {
    const [[o, p], [, q]] = scene.edges;
    drawing.face([o, p, add(p, add(q, o, -1)), q], 'good', 0.12, false);
  }
  for (const line of scene.edges) drawing.line(line, 'good', 4);
  for (const spot of scene.spots || []) drawing.mark(spot, 'good', 'dot');
  if (scene.known && scene.next) {
    drawSensor(drawing, scene.next, scene, 'aim', true);
    drawing.words(column(scene.next, 3), words, 'aim', 'bold');
    if (scene.live) drawing.line([column(scene.live, 3), column(scene.next, 3)], 'aim', 3, [7, 6]);
  }
  if (scene.known && scene.live) {
    drawSensor(drawing, scene.live, scene, 'text');
    const seen = ((profile || {}).points || []).filter((p, i) => i % 3 === 0);
    drawing.line(seen.map(([x, z]) => at(scene.live, [x, 0, z])), 'bad', 2);
    drawing.words(column(scene.live, 3), 'now', 'text', 'bold');
  }
  const ahead = scene.range_sign * 0.02;
  for (const { number, T } of scene.stations) {
    const kind = samples.get(number) || 'used', name = kind === 'used' ? 'main' : 'bad';
    if (scene.known) drawing.line([column(T, 3), at(T, [0, 0, ahead])], name, 2);
    drawing.mark(column(T, 3), name, kind, String(number));
  }
  drawing.finish();
}

const signed = v => (v < 0 ? '−' : '+') + degrees(Math.abs(v), 0) + '°';

// The first moves, in the frame of the first sample: the sensor turned about what it sees.
function drawMove({ pen, width, height }, scene) {
  const sign = scene.range_sign;
  const view = scene.view.length ? box(scene.view) : { low: [-0.03, 0.1 * sign], high: [0.03, 0.2 * sign] };
  const middle = [(view.low[0] + view.high[0]) / 2, 0, (view.low[1] + view.high[1]) / 2];
  const { R, place, turn, tilt } = scene.move || { R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    place: [middle[0], middle[2]], turn: 0, tilt: [0, 0] };
  const spot = [place[0], 0, place[1]];
  // the picture stands upright: its z is against the viewing direction
  const world = ([x, y, z]) => [x, -sign * y, -sign * z];
  const first = [[1, 0, 0, -middle[0]], [0, 1, 0, 0], [0, 0, 1, -middle[2]]];
  const lever = [0, 1, 2].map(i => R[i][0] * spot[0] + R[i][2] * spot[2]);
  const moved = R.map((row, i) => [...row, -lever[i]]);
  const upright = ([x, y, z]) => [x, y.map(v => -sign * v), z.map(v => -sign * v)];
  const [from, to] = [upright(first), upright(moved)];
  const size = 0.06, points = [...reachOf(from, scene), ...reachOf(to, scene),
    ...[[-1, -1], [1, 1]].map(([x, y]) => [size * x, size * y, 0])];
  const drawing = new Drawing(pen, camera(points, width, height), width, height);
  if (scene.round) drawing.ball([0, 0, -0.025], 0.025, 'good');
  else {
    drawing.face([[-size, 0, 0], [size, 0, 0], [size, size, 0], [-size, size, 0]], 'good', 0.12);
    drawing.line([[-size, 0, 0], [size, 0, 0]], 'good', 4);
  }
  if (scene.move) {
    drawSensor(drawing, from, scene, 'dim', true);
    drawing.words(column(from, 3), 'first sample', 'dim');
  }
  drawSensor(drawing, to, scene, 'aim');
  drawing.words(column(to, 3), scene.move ? 'next' : 'first sample', 'aim', 'bold');
  const far = Math.hypot(...middle) || 0.15;
  arrow(drawing, 0, 1, turn, far * 0.45, far + 0.02, `turn ${signed(turn)}`);
  arrow(drawing, 1, 2, tilt[0], far * 0.65, 0, `tilt ${signed(tilt[0])}`);
  arrow(drawing, 2, 0, tilt[1], far * 0.5, 0, `tilt ${signed(tilt[1])}`);
  drawing.finish();

  // An arc about the axis that is neither, from where the sensor was.
  function arrow(drawn, i, j, angle, radius, height, words) {
    if (Math.abs(angle) < 0.02) return;
    const points = [], steps = 24;
    const start = j === 2 ? -sign * Math.PI / 2 : i === 2 && sign > 0 ? Math.PI : 0;
    for (let k = 0; k <= steps; k++) {
      const p = [0, 0, 0], phi = start + angle * k / steps;
      p[i] = radius * Math.cos(phi);
      p[j] = radius * Math.sin(phi);
      if (i + j === 1) p[2] = -sign * height;
      points.push(world(p));
    }
    drawn.line(points, 'main', 4);
    const tip = points[steps], back = points[steps - 3];
    drawn.part([tip], ([[x, y]]) => {
      const [u, v] = drawn.flat(back), way = Math.atan2(y - v, x - u);
      pen.fillStyle = colour('main');
      pen.beginPath();
      for (const [r, turned] of [[0, 0], [16, 2.7], [16, -2.7]]) {
        pen.lineTo(x + r * Math.cos(way + turned), y + r * Math.sin(way + turned));
      }
      pen.fill();
    }, 0.05);
    drawn.words(tip, words, 'main', 'bold');
  }
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
  canvas.addEventListener('wheel', event => {
    if (!event.ctrlKey && document.activeElement !== canvas) return;  // the page scrolls
    event.preventDefault();
    change(0, 0, Math.exp(-0.002 * event.deltaY));
  }, { passive: false });
  const keys = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.12],
    ArrowDown: [0, -0.12], '+': [0, 0, 1.2], '-': [0, 0, 1 / 1.2] };
  canvas.addEventListener('keydown', event => {
    if (event.key === 'Home') Object.assign(eye, HOME);
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
