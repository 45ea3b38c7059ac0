'use strict';
// Shows what the node tells, several times a second, and asks it what the buttons say.

const $ = id => document.getElementById(id);
const mm = (v, digits = 3) => (1e3 * v).toFixed(digits);
const degrees = (v, digits = 4) => (v * 180 / Math.PI).toFixed(digits);
const SILENT = 3;  // s without a message, after which what is shown is old
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
  if (changed('calibration', [state.calibration, state.rows])) showAnswer(state.calibration, state.rows);
  showSteps(state);
  ring(state);
  const troubles = [state.profiles.trouble, state.poses.trouble, state.session.trouble]
    .filter(Boolean);
  $('trouble').hidden = !troubles.length;
  text('trouble', troubles.join('; '));
  text('review', [state.review, ...state.session.notes].filter(Boolean).join('; '));
  text('link', state.session.working ||
    (state.session.mode === 'still' ? 'a sample is taken at every stop' : 'samples are taken by hand'));
}

const flows = stream => stream.count > 0 && stream.age < SILENT;

function showNow(state) {
  const flowing = flows(state.profiles) && flows(state.poses);
  $('live').classList.toggle('old', !flowing);
  text('standing', !flows(state.poses) ? 'No poses.' :
    label(state.motion.standing ? 'Standing still.' : 'Moving.'));
  text('motion', flows(state.poses) ? state.motion.text : '');
  drawProfile($('profile'), state.profile);
  const p = state.profile;
  text('feature', !flows(state.profiles) ? 'No profiles.' : !p ? 'No profile with a pose around it.' :
    p.reason ? 'No feature: ' + p.reason : label('The feature is seen.'));
  $('feature').className = !flowing ? '' : p && !p.reason ? 'good' : 'bad';
  const age = stream => stream.count ? stream.age.toFixed(1) + ' s ago' : 'none yet';
  text('ages', 'last profile ' + age(state.profiles) + ', last pose ' + age(state.poses));
}

function showGuidance(guidance) {
  const list = $('advice');
  list.replaceChildren(...(guidance ? guidance.sentences : []).map(s => element('li', s)));
  $('enough').hidden = !guidance || !guidance.enough;
  text('enough', guidance && guidance.enough ? label('Enough samples') : '');
  $('enough').className = 'badge good';
  const sigmas = guidance ? guidance.sigmas : [];
  showHeadline(sigmas);
  if (!sigmas.length) {
    $('sigmas').replaceChildren(element('p', label('Nothing yet.'), 'small'));
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
  made.append(line, progress(element('div', '', 'bar'), sigma));
  return made;
}

// Full when the limit is reached: half full where sigma is twice as large.
function progress(made, sigma) {
  const share = Math.min(sigma.limit / sigma.std, 1) || 0;
  const fill = made.firstElementChild || made.appendChild(element('div'));
  fill.style.width = (100 * share).toFixed(0) + '%';
  fill.className = share < 1 ? 'short' : '';
  made.setAttribute('role', 'progressbar');
  made.setAttribute('aria-label', sigma.name);
  made.setAttribute('aria-valuenow', (100 * share).toFixed(0));
  return made;
}

function showHeadline(sigmas) {
  const points = sigmas[sigmas.length - 1];
  $('headline').hidden = $('reached').hidden = !points;
  if (!points) return;
  text('headline', 'Points are known to ' + mm(points.std, 2) + ' mm, wanted ' +
    mm(points.limit, 2) + ' mm');
  progress($('reached'), points);
}

function showSteps(state) {
  const taken = state.samples.filter(s => s.taken).length;
  const rate = stream => stream.kind + 's ' + (flows(stream) ? 'come' : 'missing');
  const enough = Boolean(state.guidance && state.guidance.enough);
  const done = {
    connect: [flows(state.profiles) && flows(state.poses),
      rate(state.profiles) + ', ' + rate(state.poses)],
    samples: [enough, String(taken)],
    answer: [state.calibration.state === 'current', label(STATES[state.calibration.state].split(':')[0])],
  };
  let now = true;
  for (const [name, [ready, words]] of Object.entries(done)) {
    const step = $('step-' + name);
    step.className = ready ? 'done' : now ? 'now' : '';
    now = now && ready;
    step.lastElementChild.textContent = words;
  }
}

let rung = null;

function ring(state) {
  const taken = state.samples.filter(s => s.taken).length;
  if (rung !== null && taken > rung && $('sound').checked) {
    const audio = new AudioContext(), tone = audio.createOscillator();
    tone.connect(audio.destination);
    tone.start();
    tone.stop(audio.currentTime + 0.15);
  }
  rung = taken;
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
  what.textContent = s.text + (s.excluded ? ' (' + label('left out') + ')' :
    s.taken && !s.believed ? ' (' + label('not used by the fit') + ')' : '');
  figure.textContent = s.residual === null ? '' : 'residual ' + mm(s.residual) +
    ' mm, against the others ' + mm(s.left_out) + ' mm';
  button.hidden = !s.taken;
  button.textContent = label(s.excluded ? 'Bring back' : 'Leave out');
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

const STATES = { none: 'none yet', current: 'current', outdated: 'outdated: samples or settings ' +
  'have changed since', withdrawn: 'withdrawn: there is no answer any more' };

function showAnswer(c, rows) {
  text('answer-state', label(STATES[c.state]) + (c.translation ? ': ' + c.child + ' in ' + c.parent : ''));
  $('answer-state').className = 'badge ' + ({ current: 'good', none: '' }[c.state] ?? 'bad');
  text('answer-text', c.state === 'none' ? '' : c.text);
  $('figures').hidden = !rows.length;
  $('figures').tBodies[0].replaceChildren(...rows.map(([name, value, std, unit]) => {
    const made = document.createElement('tr');
    made.id = 'answer-' + name.replace(' ', '-');
    made.append(...[name, value, std, unit].map(words => element('td', words)));
    return made;
  }));
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

// A browser gives up on a stream that once was answered with anything but 200: begin anew then.
let events = null;

function connect() {
  events = new EventSource('events');
  events.onmessage = event => {
    const state = JSON.parse(event.data);
    if (state.error) text('link', state.error); else show(state);
  };
  events.onerror = async () => {
    text('link', 'the node does not answer; trying again');
    if (events.readyState !== EventSource.CLOSED) return;
    setTimeout(connect, 2000);
    const answer = await fetch('page.js').catch(() => null);
    if (answer && answer.status === 401) location.reload();  // it asks for the token
  };
}
connect();

setInterval(() => {
  const silence = (Date.now() - heard) / 1000;
  document.body.classList.toggle('old', heard > 0 && silence > SILENT);
  if (heard && silence > SILENT) text('link', 'nothing heard of the node for ' +
    silence.toFixed(0) + ' s: what is shown is old');
}, 1000);

$('language').value = language;
$('language').addEventListener('change', () => {
  language = $('language').value;
  localStorage.setItem('language', language);
  translate();
  for (const key of Object.keys(shown)) delete shown[key];
  if (told) show(told);
});
translate();
