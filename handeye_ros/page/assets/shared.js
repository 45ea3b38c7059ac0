/* Copyright 2026 The handeye_ros developers. SPDX-License-Identifier: Apache-2.0 */
// What all parts of the page use: its elements, questions to the node, and the message in the footer.

export const $ = id => document.getElementById(id);
export const mm = (v, digits = 3) => (1e3 * v).toFixed(digits);
export const degrees = (v, digits = 4) => (v * 180 / Math.PI).toFixed(digits);

export const takenHere = new Set();  // numbers of samples that this browser has taken,
const takenAnswers = new Set();  // and what the node said of them
let refusedSituation = null;  // the situation after a refusal that the footer tells, null without one
let nextStateIsRefusal = false;  // whether the next state is that situation
let messageIsAnswer = false;  // whether the footer tells an answer, which may be withdrawn
const lastShown = {};

export function text(id, value) {
  if (lastShown[id] !== value) {
    lastShown[id] = value;
    $(id).textContent = value;
  }
}

export function changed(key, value) {
  const now = JSON.stringify(value);
  const before = lastShown['json ' + key];
  lastShown['json ' + key] = now;
  return now !== before;
}

export function element(name, content = '', className = '') {
  const made = document.createElement(name);
  made.textContent = content;
  made.className = className;
  return made;
}

export function say(words, good = true) {
  text('message', words);
  $('message').className = good ? 'good' : 'bad';
  refusedSituation = null;
  nextStateIsRefusal = !good;
  messageIsAnswer = false;
}

// Return whether it succeeded.
export async function ask(name, values, button) {
  button.disabled = true;
  say('…');
  let success = false, message = 'the node does not answer: is it still running?';
  try {
    const answer = await fetch('act/' + name, { method: 'POST', body: JSON.stringify(values),
      headers: { 'Content-Type': 'application/json' } });
    ({ success, message } = await answer.json());
  } catch (error) { /* the message says it */ }
  say(message, success);
  messageIsAnswer = success && ['compute_calibration', 'save_calibration'].includes(name);
  button.disabled = false;
  if (success && name === 'take_sample') takenAnswers.add(message);
  return success;
}

export function sure(question) {
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

// Take back a message that is over, and note which samples are of this browser; before: null at first.
export function follow(state, before) {
  if (before && state.profiles.count < before.profiles.count) say('');  // another node
  if (before && before.session.path && before.session.path !== state.session.path) {
    takenHere.clear();
    takenAnswers.clear();
  }
  if (state.attempt && takenAnswers.has(state.attempt.text)) takenHere.add(state.attempt.number);
  if (before && before.calibration.state !== 'withdrawn' && state.calibration.state === 'withdrawn' &&
      messageIsAnswer) say('');
  if (nextStateIsRefusal) [refusedSituation, nextStateIsRefusal] = [situation(state), false];
  if (refusedSituation !== null && refusedSituation !== situation(state)) say('');
}

// Return what a refusal may depend on: it leaves the page when this has changed.
function situation(state) {
  return JSON.stringify([state.samples.map(s => [s.number, s.taken, s.excluded]), state.profiles.flows,
    state.poses.flows, Boolean(state.session.trouble), state.session.mode, state.calibration.state,
    Boolean(state.verification.running), state.motion.standing]);
}
