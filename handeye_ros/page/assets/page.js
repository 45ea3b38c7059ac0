/* Copyright 2026 The handeye_ros developers. SPDX-License-Identifier: Apache-2.0 */
// Shows what the node tells, several times a second, and asks it what the buttons say.

import { $, ask, changed, degrees, element, follow, mm, sure, takenHere, text,
} from './shared.js';
import { drawScene } from './scene.js';
import { readSetup, showVerification } from './setup.js';

const SILENT = 3;  // s without a word of the node, after which what is shown is old
const NEAR = [5e-3, 0.053];  // m and rad from the next pose at which to stop
let latest = null, heardAt = 0;  // the last state, and when it came (ms)

// state: the fields of `contents` in page/contents.py, which are those of `state_of` in node/state.py too
function show(state) {
  follow(state, latest);
  latest = state;
  heardAt = Date.now();
  if (!state.has_just_begun) $('before').hidden = true;
  text('name', `${state.name}: hand-eye calibration`);
  text('session', `The session of now: ${state.session.path.split('/').pop() || 'none yet'}`);
  showNow(state);
  showAim(state);
  if (changed('guidance', [state.guidance, state.samples.length])) showGuidance(state.guidance);
  if (changed('samples', [state.samples, state.worst_first, state.edges])) showSamples(state);
  if (changed('scene', [state.scene, state.profile, state.samples])) redraw();
  if (changed('calibration', [state.calibration, state.rows])) showAnswer(state.calibration, state.rows);
  if (changed('verification', state.verification)) showVerification(state.verification);
  showSteps(state);
  ring(state);
  const troubles = [state.profiles.trouble, state.poses.trouble, state.session.trouble]
    .filter(Boolean);
  $('problem').hidden = !troubles.length;
  $('choose').hidden = state.profiles.flows && state.poses.flows || taken(state).length > 0;
  text('trouble', troubles.join('; '));
  text('review', [state.review_refusal, ...state.session.warnings].filter(Boolean).join('; '));
  text('link', state.session.working || state.verification.running || { still: 'a sample is taken at every stop',
    manual: 'samples are taken by hand', moving: 'samples are taken while the robot moves',
  }[state.session.mode]);
  const mode = document.querySelector(`[name=mode][value=${state.session.mode}]`);
  if (document.activeElement.name !== 'mode') mode.checked = true;
}

const taken = state => state.samples.filter(s => s.taken);
const lastTaken = state => Math.max(0, ...taken(state).map(s => s.number));

function showNow(state) {
  const flowing = state.profiles.flows && state.poses.flows;
  $('live').classList.toggle('old', !flowing);
  text('standing', !state.poses.flows ? 'No poses.' :
    state.motion.standing ? 'Standing still.' : 'Moving.');
  text('motion', state.poses.flows ? state.motion.text : '');
  const p = state.profile;
  text('feature', !state.profiles.flows ? 'No profiles.' :
    !p ? 'No profile with a pose around it.' :
      p.reason ? `No feature: ${p.reason}` : 'The feature is seen.');
  $('feature').className = !flowing ? '' : p && !p.reason ? 'good' : 'bad';
  const age = stream => (stream.count ? `${stream.age.toFixed(1)} s ago` : 'none yet');
  text('ages', `last profile ${age(state.profiles)}, last pose ${age(state.poses)}`);
}

// What is left to do until the next pose, while the robot is jogged.
function showAim({ scene, poses, guidance }) {
  const aim = poses.flows && !guidance.enough && scene.aim;
  $('togo').hidden = !aim;
  if (!aim) {
    text('axes', '');
    return;
  }
  const near = aim.distance < NEAR[0] && aim.angle < NEAR[1];
  text('togo', near ? 'You are there: stop, and wait a second' :
    `${mm(aim.distance, 0)} mm, ${degrees(aim.angle, 0)} degrees to go`);
  $('togo').className = 'figure' + (near ? ' good' : '');
  const list = (values, figure) => values.map((v, k) => 'xyz'[k] + ' ' + (v < 0 ? '−' : '+') +
    figure(Math.abs(v))).join(', ');
  text('axes', `move along the base ${list(aim.shift, v => mm(v, 0))} mm; ` +
    `turn about the flange ${list(aim.turn, v => degrees(v, 0))}°`);
}

function showGuidance(guidance) {
  const list = $('advice');
  const sentences = [...guidance.sentences], sigmas = guidance.sigmas;
  if (guidance.sample < lastTaken(latest)) {
    sentences.push(`this knows of sample ${guidance.sample}; the next is being worked in`);
  }
  list.replaceChildren(...sentences.map(s => element('li', s)));
  $('enough').hidden = !guidance.enough;
  text('enough', guidance.enough ? 'Enough samples' : '');
  showHeadline(sigmas);
  $('sigmas').replaceChildren(...(sigmas.length ? [...sigmas].reverse().map(bar) :
    [element('p', 'Nothing yet.', 'small')]));
}

// Return the name of a direction with its main axes in the place of three figures.
function inWords(name) {
  return name.replace(/\(([^)]*)\) of (\S+)/, (_, figures, frame) => {
    const parts = figures.split(',').map((v, k) => [Math.abs(Number(v)), 'xyz'[k],
      Number(v) < 0 ? '−' : '+']).sort((a, b) => b[0] - a[0]);
    return frame + ' ' + parts.filter(p => p[0] > 0.5 * parts[0][0]).map(p => p[2] + p[1]).join(' ');
  });
}

function bar(sigma) {
  const made = element('div', '', 'sigma'), line = element('div');
  const figure = v => (sigma.unit === 'm' ? mm(v) + ' mm' : degrees(v) + '°');
  const over = sigma.std > sigma.limit;
  line.append(element('span', inWords(sigma.name)),
    element('span', `${figure(sigma.std)} of ${figure(sigma.limit)}`, over ? 'bad' : 'good'));
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
  text('headline', `Points are known to ${mm(points.std, 2)} mm, wanted ${mm(points.limit, 2)} mm`);
  progress($('reached'), points);
}

const rates = {};

// Return messages a second over the last seconds.
function rate(stream) {
  const now = Date.now() / 1e3, known = rates[stream.kind] = (rates[stream.kind] || [])
    .filter(([time, count]) => now - time < 4 && count <= stream.count);
  known.push([now, stream.count]);
  const [[time, count]] = known;
  return now - time < 1 ? '' : ((stream.count - count) / (now - time)).toFixed(0) + ' /s';
}

// The step of now is the first that is not done; its button is the main one.
function showSteps(state) {
  const c = state.calibration, { running, verdict } = state.verification;
  const missing = [state.profiles, state.poses].filter(stream => !stream.flows)
    .map(stream => (stream === state.poses ? 'No poses' : 'No profiles'));
  const done = {
    connect: [!missing.length, missing.join(', ') || [state.profiles, state.poses].map(rate).join(', ')],
    samples: [state.guidance.enough, String(taken(state).length)],
    answer: [c.state === 'current', STATES[c.state].split(':')[0]],
    verify: [verdict === 'pass', running || verdict || 'if you like'],
    save: [Boolean(c.saved), c.saved ? 'saved' : 'not yet'],
  };
  let now = '';
  for (const [name, [ready, words]] of Object.entries(done)) {
    const step = $('step-' + name);
    if (!ready && !now && name !== 'verify') now = name;
    step.className = ready ? 'done' : now === name ? 'now' : name === 'verify' && verdict === 'fail' ? 'lost' : '';
    step.querySelector('span').textContent = words;
    if (now === name) step.setAttribute('aria-current', 'step'); else step.removeAttribute('aria-current');
  }
  const main = { connect: '', samples: 'take', answer: 'compute', save: 'save' }[now];
  for (const name of ['take', 'compute', 'save']) $(name).className = name === main ? 'main' : '';
}

let audio = null, lastAttempt = null;

// High for a sample, low for a stop that gave none.
function ring(state) {
  const attempt = JSON.stringify(state.attempt);
  if (lastAttempt !== null && attempt !== lastAttempt && state.attempt && audio && $('sound').checked) {
    const tone = audio.createOscillator(), volume = audio.createGain();
    tone.frequency.value = state.attempt.accepted ? 880 : 220;
    volume.gain.value = 0.3;
    tone.connect(volume).connect(audio.destination);
    tone.start();
    tone.stop(audio.currentTime + (state.attempt.accepted ? 0.15 : 0.4));
  }
  lastAttempt = attempt;
}

// a browser lets a page sound only after somebody has asked it to
$('sound').addEventListener('change', () => { audio = audio || new AudioContext(); });

function showSamples(state) {
  text('count', '(' + taken(state).length + ')');
  const place = new Map(state.worst_first.map((number, i) => [number, i]));
  const last = state.worst_first.length;
  const order = [...state.samples].sort((a, b) =>
    (place.get(a.number) ?? last) - (place.get(b.number) ?? last) || b.number - a.number);
  const largest = Math.max(...state.samples.map(s => s.left_out || 0), 1e-9);
  const now = order.map(s => updateLine(s, state, largest));
  const list = $('samples');
  // lines stay what and where they are as long as possible: a finger may be on one
  now.forEach((line, i) => {
    if (list.children[i] !== line) list.insertBefore(line, list.children[i] || null);
  });
  while (list.children.length > now.length) list.lastChild.remove();
}

const lineOfSample = new Map();

function updateLine(s, state, largest) {
  const key = s.number + ' ' + s.stamp;  // another session numbers from 1 again
  if (!lineOfSample.has(key)) lineOfSample.set(key, newLine(s.number));
  const { line, number, edge, tilt, time, fill, figure, why, button } = lineOfSample.get(key);
  line.className = s.excluded ? 'out' : '';
  number.textContent = s.number;
  edge.textContent = !s.taken ? 'no sample' : s.excluded ? 'excluded' :
    !s.believed ? 'not used' : state.edges[s.number] ? `edge ${state.edges[s.number]}` :
      'used';
  edge.className = s.taken && s.believed || s.excluded ? 'what' : 'what bad';
  const angle = tiltOf(s, state);
  tilt.textContent = angle === null ? '' : `tilt ${degrees(angle, 0)}°`;
  time.textContent = new Date(s.stamp / 1e6).toLocaleTimeString([], { timeStyle: 'medium' });
  const size = s.left_out ?? s.residual;
  fill.parentElement.style.visibility = size === null ? 'hidden' : '';
  fill.style.width = (100 * (size || 0) / largest).toFixed(0) + '%';
  fill.className = s.believed ? '' : 'short';
  figure.textContent = size === null ? '' : mm(size) + ' mm';
  why.textContent = [s.text, s.residual === null ? '' :
    `residual ${mm(s.residual)} mm, against the others ${mm(s.left_out ?? s.residual)} mm`,
  s.taken && !s.believed && !s.excluded ? 'the fit does not use it: it contradicts the others' : '']
    .filter(Boolean).join('; ');
  button.hidden = !s.taken;
  button.textContent = s.excluded ? 'Include' : 'Exclude';
  button.dataset.sample = s.number;
  button.setAttribute('aria-label', button.textContent + ' ' + s.number);
  button.onclick = () => ask('exclude', { number: s.number, excluded: !s.excluded }, button);
  return line;
}

// Return the angle of the viewing direction to that of the first sample (rad), null if unknown.
function tiltOf(s, { scene }) {
  const own = scene.known && scene.samples.find(({ number }) => number === s.number);
  if (!own) return null;
  const [a, b] = [own, scene.samples[0]].map(({ T }) => column(T, 2));
  return Math.acos(Math.min(1, a[0] * b[0] + a[1] * b[1] + a[2] * b[2]));
}

function newLine(number) {
  const made = { line: document.createElement('li'), number: element('strong'),
    edge: element('span', '', 'what'), tilt: element('span'), time: element('span', '', 'small'),
    fill: element('div'), figure: element('span', '', 'residual'), why: element('p', '', 'small'),
    button: element('button') };
  const details = element('details'), head = element('summary'), full = element('div', '', 'bar');
  const canvas = document.createElement('canvas');
  full.append(made.fill);
  head.append(made.number, made.edge, made.tilt, made.time, full, made.figure);
  details.append(head, made.why, canvas);
  made.line.append(details, made.button);
  canvas.setAttribute('role', 'img');
  canvas.setAttribute('aria-label', 'the profile of sample ' + number);
  details.addEventListener('toggle', async () => {
    if (!details.open) return;
    const answer = await fetch('read/stop?number=' + number).catch(() => null);
    if (answer && answer.ok) drawProfile(canvas, await answer.json(), latest.scene.view);
  });
  return made;
}

const STATES = { none: 'none yet', current: 'current', outdated: 'outdated: samples have changed since',
  withdrawn: 'withdrawn: there is no answer any more' };

function showAnswer(c, rows) {
  text('answer-state', STATES[c.state] +
    (c.translation ? `: ${c.child} in ${c.parent}` : ''));
  $('answer-state').className = 'badge ' + ({ current: 'good', none: 'dim' }[c.state] ?? 'bad');
  text('answer-text', c.state === 'none' ? '' : c.text);
  text('saved', c.saved ? `saved in ${c.saved}` : '');
  $('figures').hidden = $('files').hidden = !rows.length;
  const quality = rows.length ? [['residual', mm(c.residual_rms), '', 'mm'],
    ['left out', mm(c.holdout_rms), '', 'mm'], ['samples used', String(c.used), '', '']] : [];
  $('figures').tBodies[0].replaceChildren(...rows.concat(quality).map(([name, value, std, unit]) => {
    const made = document.createElement('tr');
    made.id = 'answer-' + name.replace(' ', '-');
    made.append(...[name, value, std, unit].map(words => element('td', words)));
    return made;
  }));
}

async function clearAll() {
  const count = latest ? taken(latest).length : 0;
  if (await sure(`Clear all samples (${count})?`) &&
      await sure(`Begin a new session? All samples (${count}) stay on the disk; "Go on with it" ` +
        'brings them back. The calibration is withdrawn.')) {
    await ask('clear_samples', {}, $('clear'));
    readSetup();
  }
}

async function undo() {
  const last = latest ? lastTaken(latest) : 0;
  if (!last || takenHere.has(last) ||
      await sure(`Sample ${last} was not taken with this browser. Remove it?`)) {
    await ask('remove_last_sample', last ? { number: last } : {}, $('undo'));
  }
}

for (const [name, service] of [['take', 'take_sample'], ['compute', 'compute_calibration'],
  ['save', 'save_calibration']]) {
  $(name).addEventListener('click', () => ask(service, {}, $(name)));
}
$('undo').addEventListener('click', undo);
$('clear').addEventListener('click', clearAll);
$('new').addEventListener('click', clearAll);

function redraw() {
  if (!latest) return;
  const kinds = new Map(latest.samples.map(s => [s.number,
    s.excluded ? 'out' : s.believed ? 'used' : 'unused']));
  drawScene($('scene'), latest.scene, kinds, latest.profile, $('togo').hidden ? 'next' :
    $('togo').textContent);
  drawProfile($('profile'), latest.profile, latest.scene.view);
}
turnable($('scene'), redraw);
addEventListener('resize', redraw);
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', redraw);

// A browser gives up on a stream that once was answered with anything but 200: begin anew then.
let events = null;

function connect() {
  events = new EventSource('events');
  events.onopen = readSetup;  // also when the node was started anew
  events.onmessage = event => {
    const state = JSON.parse(event.data);
    if (state.error) text('link', state.error); else show(state);
  };
  events.onerror = async () => {
    text('link', 'the node does not answer; trying again');
    if (events.readyState !== EventSource.CLOSED) return;
    setTimeout(connect, 2000);
    const answer = await fetch('events').catch(() => null);
    if (answer && answer.status === 401) location.reload();  // it asks for the token
    else if (answer && answer.ok) answer.body.cancel();
    else if (answer) text('link', (await answer.json()).message);
  };
}

setInterval(() => {
  const silence = (Date.now() - heardAt) / 1000;
  const old = heardAt > 0 && silence > SILENT;
  document.body.classList.toggle('old', old);
  if (old) text('link', `nothing heard of the node for ${silence.toFixed(0)} s: what is shown is old`);
}, 1000);
connect();
