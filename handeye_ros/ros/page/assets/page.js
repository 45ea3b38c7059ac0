'use strict';
// Shows what the node tells, several times a second, and asks it what the buttons say.

const $ = id => document.getElementById(id);
const mm = (v, digits = 3) => (1e3 * v).toFixed(digits);
const degrees = (v, digits = 4) => (v * 180 / Math.PI).toFixed(digits);
let told = null, heard = 0;
const shown = {};

function text(id, value) {
  if (shown[id] !== value) {
    shown[id] = value;
    $(id).textContent = value;
  }
}

function changed(key, value) {
  const now = JSON.stringify(value);
  const before = shown['json ' + key];
  shown['json ' + key] = now;
  return now !== before;
}

function element(name, content = '', className = '') {
  const made = document.createElement(name);
  made.textContent = content;
  made.className = className;
  return made;
}

function show(state) {
  told = state;
  heard = Date.now();
  text('name', state.name + ': hand-eye calibration');
  showNow(state);
  if (changed('guidance', state.guidance)) showGuidance(state.guidance);
  if (changed('scene', state.scene)) drawScene($('scene'), state.scene);
  if (changed('samples', [state.samples, state.worst])) showSamples(state);
  if (changed('calibration', state.calibration)) showAnswer(state.calibration);
  const troubles = [state.profiles.trouble, state.poses.trouble, state.session.trouble]
    .filter(Boolean);
  $('trouble').hidden = !troubles.length;
  text('trouble', troubles.join('; '));
  text('review', [state.review, ...state.session.notes].filter(Boolean).join('; '));
  text('link', state.session.working ||
    (state.session.mode === 'still' ? 'a sample is taken at every stop' : 'samples are taken by hand'));
}

function showNow(state) {
  text('standing', state.motion.standing ? 'Standing still.' : 'Moving.');
  text('motion', state.motion.text);
  drawProfile($('profile'), state.profile);
  const p = state.profile;
  text('feature', !p ? 'No profile with a pose around it.' : p.reason ? 'No feature: ' + p.reason :
    'The feature is seen.');
  $('feature').className = p && !p.reason ? 'good' : 'bad';
  const age = stream => stream.count ? stream.age.toFixed(1) + ' s ago' : 'none yet';
  text('ages', 'last profile ' + age(state.profiles) + ', last pose ' + age(state.poses));
}

function showGuidance(guidance) {
  const list = $('advice');
  list.replaceChildren(...(guidance ? guidance.sentences : []).map(s => element('li', s)));
  $('enough').hidden = !guidance || !guidance.enough;
  text('enough', guidance && guidance.enough ? 'Enough samples' : '');
  $('enough').className = 'badge good';
  const sigmas = guidance ? guidance.sigmas : [];
  if (!sigmas.length) {
    $('sigmas').replaceChildren(element('p', 'Nothing yet.', 'small'));
    return;
  }
  $('sigmas').replaceChildren(...[...sigmas].reverse().map(bar));
}

function bar(sigma) {
  const made = element('div', '', 'sigma'), line = element('div');
  const figure = v => sigma.unit === 'm' ? mm(v) + ' mm' : degrees(v) + '°';
  const over = sigma.std > sigma.limit;
  line.append(element('span', sigma.name),
    element('span', figure(sigma.std) + ' of ' + figure(sigma.limit), over ? 'bad' : 'good'));
  const meter = document.createElement('meter');
  meter.max = 2 * sigma.limit;
  meter.high = meter.low = sigma.limit;
  meter.optimum = 0;
  meter.value = sigma.std;
  meter.setAttribute('aria-label', sigma.name);
  made.append(line, meter);
  return made;
}

function showSamples(state) {
  const taken = state.samples.filter(s => s.taken).length;
  text('count', '(' + taken + ')');
  const place = new Map(state.worst.map((number, i) => [number, i]));
  const last = state.worst.length;
  const order = [...state.samples].sort((a, b) =>
    (place.get(a.number) ?? last) - (place.get(b.number) ?? last) || b.number - a.number);
  const now = order.map(sample);
  const list = $('samples');
  // lines stay what and where they are as long as possible: a finger may be on one
  now.forEach((line, i) => {
    if (list.children[i] !== line) list.insertBefore(line, list.children[i] || null);
  });
  while (list.children.length > now.length) list.lastChild.remove();
}

const lines = new Map();

function sample(s) {
  if (!lines.has(s.number)) lines.set(s.number, newLine());
  const { line, number, what, figure, button } = lines.get(s.number);
  line.className = s.excluded ? 'out' : '';
  number.textContent = s.number;
  what.textContent = s.text + (s.excluded ? ' (left out)' :
    s.taken && !s.believed ? ' (not believed)' : '');
  figure.textContent = s.residual === null ? '' : 'residual ' + mm(s.residual) +
    ' mm, against the others ' + mm(s.left_out) + ' mm';
  button.hidden = !s.taken;
  button.textContent = s.excluded ? 'Bring back' : 'Leave out';
  button.setAttribute('aria-label', button.textContent + ' sample ' + s.number);
  button.dataset.sample = s.number;
  button.onclick = () => ask(s.excluded ? 'include' : 'exclude', { number: s.number }, button);
  return line;
}

function newLine() {
  const made = { line: element('li'), number: element('strong'), what: element('span', '', 'what'),
    figure: element('span', '', 'figure'), button: element('button') };
  made.line.append(made.number, made.what, made.figure, made.button);
  return made;
}

function showAnswer(c) {
  const words = { none: 'none yet', current: 'current', outdated: 'outdated: samples or settings ' +
    'have changed since', withdrawn: 'withdrawn: there is no answer any more' };
  text('answer-state', words[c.state]);
  $('answer-state').className = 'badge ' + (c.state === 'current' ? 'good' : 'bad');
  text('answer-text', c.text);
  $('figures').hidden = !c.translation;
  if (!c.translation) return;
  const row = (id, name, value, std, unit) => {
    const made = document.createElement('tr');
    const cell = element('td', value);
    cell.id = id;
    made.append(element('td', name), cell, element('td', std), element('td', unit));
    return made;
  };
  const rows = ['x', 'y', 'z'].map((axis, i) =>
    row('answer-' + axis, axis, mm(c.translation[i]), mm(c.std[i]), 'mm'));
  rows.push(...['roll', 'pitch', 'yaw'].map((name, i) =>
    row('answer-' + name, name, degrees(c.rpy[i]), degrees(c.std[3 + i]), '°')));
  rows.push(row('answer-residual', 'residual', mm(c.residual_rms), '', 'mm'),
    row('answer-holdout', 'left out', mm(c.holdout_rms), '', 'mm'),
    row('answer-used', 'samples used', String(c.used), '', ''));
  $('figures').tBodies[0].replaceChildren(...rows);
  text('answer-state', words[c.state] + ': ' + c.child + ' in ' + c.parent);
}

async function ask(name, values, button) {
  button.disabled = true;
  text('message', '…');
  try {
    const answer = await fetch('act/' + name, { method: 'POST', body: JSON.stringify(values),
      headers: { 'Content-Type': 'application/json' } });
    const { success, message } = await answer.json();
    text('message', message);
    $('message').className = success ? 'good' : 'bad';
  } catch (error) {
    text('message', 'the node does not answer: is it still running?');
    $('message').className = 'bad';
  }
  button.disabled = false;
}

function sure(question) {
  return new Promise(resolve => {
    text('question', question);
    const dialog = $('sure');
    const done = answer => { dialog.close(); resolve(answer); };
    $('yes').onclick = () => done(true);
    $('no').onclick = () => done(false);
    dialog.oncancel = () => resolve(false);
    dialog.showModal();
  });
}

async function clearAll() {
  const count = told ? told.samples.filter(s => s.taken).length : 0;
  if (await sure('Clear all ' + count + ' samples?') &&
      await sure('Really? ' + count + ' samples and the answer will be gone.')) {
    await ask('clear', {}, $('clear'));
  }
}

for (const name of ['take', 'undo', 'compute', 'save']) {
  $(name).addEventListener('click', () => ask(name, {}, $(name)));
}
$('clear').addEventListener('click', clearAll);

function redraw() {
  if (!told) return;
  drawScene($('scene'), told.scene);
  drawProfile($('profile'), told.profile);
}
turnable($('scene'), redraw);
addEventListener('resize', redraw);
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', redraw);

const events = new EventSource('events');
events.onmessage = event => {
  const state = JSON.parse(event.data);
  if (state.error) text('link', state.error); else show(state);
};
events.onerror = () => text('link', 'the node does not answer; trying again');
setInterval(() => {
  if (heard && Date.now() - heard > 3000) text('link', 'nothing heard of the node for ' +
    ((Date.now() - heard) / 1000).toFixed(0) + ' s: what is shown is old');
}, 1000);
