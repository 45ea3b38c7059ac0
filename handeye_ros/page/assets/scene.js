/* Copyright 2026 The handeye_ros developers. SPDX-License-Identifier: Apache-2.0 */
// The picture in space: sensor and light plane of now, target, samples, and the next pose.
// viewer.js and profile.js are no modules, as the report holds them: what they declare is global.

import { degrees } from './shared.js';

const SENSOR = [0.012, 0.02, 0.025];  // m: half sizes of the body that is drawn

// Return the outline of the field of view, a usual one while none is known.
function viewOf({ view, range_sign: sign }) {
  return view.length ? view : [[-0.03, 0.15 * sign], [0.03, 0.15 * sign]];
}

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
  const view = viewOf(scene), xs = view.map(p => p[0]), zs = view.map(p => p[1] * sign);
  const far = Math.max(...zs) * sign;
  const fan = [[0, 0], [Math.min(...xs), far], [Math.max(...xs), far]]
    .map(([x, z]) => at(T, [x, 0, z]));
  drawing.face(fan, ghost ? name : 'bad', ghost ? 0.06 : 0.16);
  drawing.line([fan[1], fan[2]], ghost ? name : 'bad', 1, [4, 4]);
}

function reachOf(T, scene) {
  const behind = at(T, [0, 0, -2 * SENSOR[2] * scene.range_sign]);
  return [behind, ...viewOf(scene).map(([x, z]) => at(T, [x, 0, z]))];
}

// scene, profile: of _scene and _picture in page/contents.py, the latter may be null; samples: a Map of
// numbers to used, out or unused; words: at the next pose
export function drawScene(canvas, scene, samples, profile, words) {
  const made = board(canvas), { pen, width, height } = made;
  if (!scene.known && (scene.move || !scene.samples.length)) return drawMove(made, scene);
  const points = [...scene.samples.map(s => column(s.T, 3)), ...scene.edges.flat(),
    ...scene.outline.flat(), ...scene.spots];
  if (scene.known && scene.now) points.push(...reachOf(scene.now, scene));
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
  for (const spot of scene.spots) drawing.mark(spot, 'good', 'dot');
  if (scene.known && scene.next) {
    drawSensor(drawing, scene.next, scene, 'aim', true);
    drawing.words(column(scene.next, 3), words, 'aim', 'bold');
    if (scene.now) drawing.line([column(scene.now, 3), column(scene.next, 3)], 'aim', 3, [7, 6]);
  }
  if (scene.known && scene.now) {
    drawSensor(drawing, scene.now, scene, 'text');
    const seen = ((profile || {}).points || []).filter((p, i) => i % 3 === 0);
    drawing.line(seen.map(([x, z]) => at(scene.now, [x, 0, z])), 'bad', 2);
    drawing.words(column(scene.now, 3), 'now', 'text', 'bold');
  }
  const ahead = scene.range_sign * 0.02;
  for (const { number, T } of scene.samples) {
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
  const view = box(viewOf(scene));
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
