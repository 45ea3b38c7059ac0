/* Copyright 2026 The handeye_ros developers. SPDX-License-Identifier: Apache-2.0 */
'use strict';
// The picture of a profile: points, found faces and edges, in the field of view seen so far.

function note(board, words) {
  board.pen.fillStyle = colour('dim');
  board.pen.font = '15px system-ui, sans-serif';
  board.pen.fillText(words, 14, board.height / 2);
}

// Lines every 1, 2 or 5 times a power of ten millimetres, at least 56 pixels apart.
function grid(pen, width, height, place, scale) {
  const least = 56 / scale, power = 10 ** Math.floor(Math.log10(least));
  const step = [1, 2, 5, 10].map(k => k * power).find(s => s >= least);
  const digits = Math.max(0, -Math.floor(Math.log10(step * 1e3)));
  const [x0, z0] = place([0, 0]);
  const words = [];
  pen.strokeStyle = colour('line');
  pen.lineWidth = 1;
  pen.beginPath();
  for (let k = Math.ceil((30 - x0) / scale / step); x0 + k * step * scale < width; k++) {
    const x = x0 + k * step * scale;
    pen.moveTo(x, 0);
    pen.lineTo(x, height - 18);
    words.push([(1e3 * k * step).toFixed(digits), x, height - 5, 'center']);
  }
  for (let k = Math.ceil(-z0 / scale / step); z0 + k * step * scale < height - 24; k++) {
    const z = z0 + k * step * scale;
    pen.moveTo(36, z);
    pen.lineTo(width, z);
    if (z > 24) words.push([(1e3 * k * step).toFixed(digits), 32, z + 4, 'right']);
  }
  pen.stroke();
  pen.fillStyle = colour('dim');
  for (const [word, x, y, align] of words) {
    pen.textAlign = align;
    pen.fillText(word, x, y);
  }
  pen.textAlign = 'left';
  pen.fillText('range / mm', 4, 13);
  pen.textAlign = 'right';
  pen.fillText('x / mm', width - 4, height - 22);
  pen.textAlign = 'left';
}

// view: the corners of what was seen so far, so that the picture does not jump
function drawProfile(canvas, profile, view) {
  const made = board(canvas), { pen, width, height } = made;
  if (!profile || !(profile.points.length + view.length)) {
    note(made, 'no profile with a return');
    return;
  }
  const bounds = box([...view, ...profile.points]), edge = 40;
  // one scale for both axes: what is square is shown square
  const size = [0, 1].map(k => Math.max(bounds.high[k] - bounds.low[k], 1e-6));
  const scale = Math.min((width - 2 * edge) / size[0], (height - 2 * edge) / size[1]);
  const middle = [0, 1].map(k => (bounds.low[k] + bounds.high[k]) / 2);
  const place = p => [width / 2 + 8 + (p[0] - middle[0]) * scale,
    height / 2 - 4 + (p[1] - middle[1]) * scale];
  grid(pen, width, height, place, scale);
  if (view.length) {
    pen.setLineDash([6, 5]);
    pen.strokeStyle = colour('dim');
    stroke(pen, [...view, view[0]].map(place));
    pen.setLineDash([]);
  }
  pen.fillStyle = colour('text');
  for (const p of profile.points) {
    const [x, y] = place(p);
    pen.fillRect(x - 1, y - 1, 2, 2);
  }
  pen.strokeStyle = colour('main');
  pen.lineWidth = 4;
  for (const line of profile.lines) stroke(pen, line.map(place));
  for (const spot of profile.spots) {
    pen.fillStyle = colour('card');
    dot(pen, place(spot), 8);
    pen.fillStyle = colour('aim');
    dot(pen, place(spot), 6);
  }
}
