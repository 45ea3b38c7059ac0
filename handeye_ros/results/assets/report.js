/* Copyright 2026 The handeye_ros developers. SPDX-License-Identifier: Apache-2.0 */
'use strict';
// The cell and the profiles of the report, and what is copied from it.
(() => {
  const { parts } = JSON.parse(document.getElementById('data').textContent);
  const profiles = JSON.parse(document.getElementById('profiles').textContent);
  const canvas = document.getElementById('scene');
  const all = parts.flatMap(part => part.line || part.points);
  const low = [0, 1, 2].map(k => all.reduce((least, p) => Math.min(least, p[k]), Infinity));
  const axes = [['x', '#c62828'], ['y', '#2e7d32'], ['z', '#1565c0']].map(([name, color], k) =>
    ({ name, color, tip: low.map((v, i) => v + (i === k ? 0.05 : 0)) }));
  const seen = [...all, low, ...axes.map(({ tip }) => tip)];

  function draw() {
    const { pen, width, height } = board(canvas);
    pen.fillStyle = '#fff';
    pen.fillRect(0, 0, width, height);
    const drawing = new Drawing(pen, camera(seen, width, height), width, height);
    for (const { line, points, color, width: size } of parts) {
      if (line) drawing.line(line, color, size);
      else for (const point of points) {
        drawing.part([point], ([[x, y]]) => {
          pen.fillStyle = color;
          pen.fillRect(x - size / 2, y - size / 2, size, size);
        });
      }
    }
    for (const { name, color, tip } of axes) {
      drawing.line([low, tip], color, 2);
      drawing.words(tip, name, color);
    }
    drawing.finish();
  }

  function drawAll() {
    draw();
    document.querySelectorAll('.profiles canvas').forEach(
      (picture, i) => drawProfile(picture, profiles[i], []));
  }

  turnable(canvas, draw);
  for (const event of ['resize', 'beforeprint']) addEventListener(event, drawAll);
  drawAll();

  for (const button of document.querySelectorAll('.copy button')) {
    button.addEventListener('click', async () => {
      const text = button.nextElementSibling;
      try {
        await navigator.clipboard.writeText(text.textContent);
        button.textContent = 'copied';
      } catch {  // no clipboard for a file: select it, for Ctrl-C
        getSelection().selectAllChildren(text);
        button.textContent = 'press Ctrl-C';
      }
    });
  }
})();
