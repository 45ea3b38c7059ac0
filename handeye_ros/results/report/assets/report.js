'use strict';
// Turns the scene with the pointer; no library, as it draws lines and points only.
(() => {
  const scene = JSON.parse(document.getElementById('data').textContent);
  const canvas = document.getElementById('scene');
  const pen = canvas.getContext('2d');
  const all = scene.parts.flatMap((part) => part.line || part.points);
  const [low, high] = bounds(all);
  const middle = low.map((v, k) => (v + high[k]) / 2);
  let turn = -0.9, tilt = 0.45, zoom = 1;

  function bounds(points) {
    const axes = points[0].map((_, k) => points.map((p) => p[k]));
    return [axes.map((v) => Math.min(...v)), axes.map((v) => Math.max(...v))];
  }

  // Orthographic, seen from outside; z is up. Returns right, down, depth in pixels.
  function project(p, scale = 1, width = 0, height = 0) {
    const [x, y, z] = p.map((v, k) => v - middle[k]);
    const c = Math.cos(turn), s = Math.sin(turn), ct = Math.cos(tilt), st = Math.sin(tilt);
    const along = c * y - s * x, into = c * x + s * y;
    return [width / 2 + scale * along, height / 2 - scale * (ct * z - st * into),
            ct * into + st * z];
  }

  // As large as it can be seen whole from where it is seen first.
  const [left, right] = bounds(all.map((p) => project(p)));
  const fit = (width, height) => 0.45 * Math.min(
    width / Math.max(-left[0], right[0], 1e-9), height / Math.max(-left[1], right[1], 1e-9));

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = '#fff';
    pen.fillRect(0, 0, width, height);
    const scale = zoom * fit(width, height);
    const pieces = [];
    for (const part of scene.parts) {
      const points = (part.line || part.points).map((p) => project(p, scale, width, height));
      if (part.line) {
        points.slice(1).forEach((b, i) => pieces.push({part, a: points[i], b,
          depth: (points[i][2] + b[2]) / 2}));
      } else {
        points.forEach((a) => pieces.push({part, a, depth: a[2]}));
      }
    }
    pieces.sort((a, b) => a.depth - b.depth);
    for (const {part, a, b} of pieces) {
      if (b) {
        pen.strokeStyle = part.color;
        pen.lineWidth = part.width;
        pen.beginPath();
        pen.moveTo(a[0], a[1]);
        pen.lineTo(b[0], b[1]);
        pen.stroke();
      } else {
        pen.fillStyle = part.color;
        pen.fillRect(a[0] - part.width / 2, a[1] - part.width / 2, part.width, part.width);
      }
    }
    canvas.dataset.drawn = pieces.length;
  }

  const fingers = new Map();
  const apart = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  };
  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener('pointermove', (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const span = fingers.size === 2 ? apart() : 0;
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (span) {
      zoom *= apart() / span;
    } else {
      turn -= (event.clientX - before[0]) * 0.01;
      tilt = Math.max(-1.57, Math.min(1.57, tilt + (event.clientY - before[1]) * 0.01));
    }
    draw();
  });
  for (const end of ['pointerup', 'pointercancel']) {
    canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    zoom *= Math.exp(-event.deltaY * 0.001);
    draw();
  }, {passive: false});
  window.addEventListener('resize', draw);
  window.addEventListener('beforeprint', draw);
  draw();

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
