'use strict';
// Turns the scene with the pointer; no library, as it draws lines and points only.
(() => {
  const scene = JSON.parse(document.getElementById('data').textContent);
  const canvas = document.getElementById('scene');
  const pen = canvas.getContext('2d');
  const all = scene.parts.flatMap((part) => part.line || part.points);
  const [low, high] = bounds(all);
  const FIRST = {turn: -0.9, tilt: 0.45, zoom: 1};
  const AXES = [['x', '#c62828'], ['y', '#2e7d32'], ['z', '#1565c0']];
  let turn, tilt, zoom, middle;  // middle: what it turns about, in the middle of the picture

  function reset() {
    ({turn, tilt, zoom} = FIRST);
    middle = low.map((v, k) => (v + high[k]) / 2);
  }
  reset();

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

  // Zoom on the point nearest to a place of the picture: that is what it turns about from then on.
  function zoomAt(factor, x, y) {
    const width = canvas.clientWidth, height = canvas.clientHeight;
    const next = Math.max(0.3, Math.min(60, zoom * factor));
    const scale = zoom * fit(width, height);
    const nearest = all.map((p) => {
      const [right, down] = project(p, scale, width, height);
      return [Math.hypot(right - x, down - y), p];
    }).reduce((a, b) => (b[0] < a[0] ? b : a))[1];
    const share = Math.max(0, 1 - zoom / next);
    middle = middle.map((v, k) => v + share * (nearest[k] - v));
    zoom = next;
    draw();
  }

  function drawAxes(height) {
    const [left, bottom] = project(middle, 1, 80, 2 * height - 80);
    pen.lineWidth = 2;
    pen.font = '12px system-ui, sans-serif';
    AXES.forEach(([name, color], k) => {
      const tip = project(middle.map((v, i) => v + (i === k)), 28, 80, 2 * height - 80);
      pen.strokeStyle = pen.fillStyle = color;
      pen.beginPath();
      pen.moveTo(left, bottom);
      pen.lineTo(tip[0], tip[1]);
      pen.stroke();
      pen.fillText(name, tip[0] + 3, tip[1] + 4);
    });
  }

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
    drawAxes(height);
    canvas.dataset.drawn = pieces.length;
  }

  function rotate(right, down) {
    turn -= right * 0.01;
    tilt = Math.max(-1.57, Math.min(1.57, tilt + down * 0.01));
    draw();
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
      const box = canvas.getBoundingClientRect();
      const [x, y] = [0, 1].map((k) => [...fingers.values()].reduce((sum, f) => sum + f[k], 0) / 2);
      zoomAt(apart() / span, x - box.left, y - box.top);
    } else {
      rotate(event.clientX - before[0], event.clientY - before[1]);
    }
  });
  for (const end of ['pointerup', 'pointercancel']) {
    canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    zoomAt(Math.exp(-event.deltaY * 0.001), event.offsetX, event.offsetY);
  }, {passive: false});
  const again = () => {
    reset();
    draw();
  };
  const enlarge = (factor) => zoomAt(factor, canvas.clientWidth / 2, canvas.clientHeight / 2);
  const keys = {
    ArrowLeft: () => rotate(-10, 0), ArrowRight: () => rotate(10, 0),
    ArrowUp: () => rotate(0, -10), ArrowDown: () => rotate(0, 10),
    '+': () => enlarge(1.2), '-': () => enlarge(1 / 1.2), '0': again,
  };
  canvas.addEventListener('keydown', (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    keys[event.key]();
  });
  canvas.addEventListener('dblclick', again);
  document.getElementById('reset').addEventListener('click', again);
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
