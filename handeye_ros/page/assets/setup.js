/* Copyright 2026 The handeye_ros developers. SPDX-License-Identifier: Apache-2.0 */
// What a person sets: how samples are taken, topics and the like, sessions, and a verification.

import { $, ask, element, say, sure, text } from './shared.js';

let nominalKeys = {};  // which of these each routine needs
let verification = {};  // of the last state
const written = value => (Array.isArray(value) ? `[${value.join(', ')}]` : String(value));

function setting({ key, label, value, description, choices }) {
  const made = element('div', '', 'setting'), name = element('label', label);
  let input = document.createElement('input');
  if (choices.length || key.endsWith('topic')) {
    input = document.createElement('select');
    for (const choice of new Set([...choices, value])) {
      const option = element('option', String(choice) || '—');
      option.value = choice;
      input.append(option);
    }
  } else input.autocomplete = 'off';
  input.id = name.htmlFor = 'set-' + key;
  input.name = key;
  input.value = made.dataset.before = written(value);
  made.append(name, input);
  made.dataset.key = key;
  made.append(element('span', description, 'small'));
  return made;
}

export async function readSetup() {
  const answer = await fetch('read/setup').catch(() => null);
  if (!answer) return;
  if (!answer.ok) {
    say((await answer.json()).message, false);
    return;
  }
  const { settings, nominal_keys, sessions, previous } = await answer.json();
  nominalKeys = nominal_keys;
  const edited = Object.entries(valuesOf('verify-form'));
  const parts = verify => settings.filter(s => s.label && s.key.startsWith('verify.') === verify);
  $('setup-form').replaceChildren(...parts(false).map(s => {
    const made = setting(s), button = element('button', 'Set');
    button.type = 'button';
    button.addEventListener('click', async () => {
      await ask('set', { [s.key]: made.querySelector('input, select').value }, button);
      readSetup();
    });
    made.insertBefore(button, made.lastChild);
    return made;
  }));
  $('verify-form').replaceChildren(...parts(true).map(setting));
  for (const [key, value] of edited) $('set-' + key).value = value;
  const routine = $('set-verify.routine');
  routine.addEventListener('change', showNominal);
  showNominal();
  $('before').hidden = !previous;
  text('before-text', `The previous session holds ${previous} sample${previous === 1 ? '' : 's'}.`);
  $('sessions').replaceChildren(...sessions.map(name => element('option', name)));
  $('open').disabled = !$('sessions').options.length;
}

// Only what the routine needs is asked for.
function showNominal() {
  const needed = ['verify.routine', 'verify.tolerance',
    ...(nominalKeys[$('set-verify.routine').value] || [])];
  for (const made of $('verify-form').children) made.hidden = !needed.includes(made.dataset.key);
}

// What differs from the settings that the form was made of.
function valuesOf(form) {
  const values = {};
  for (const made of $(form).children) {
    const { value } = made.querySelector('input, select');
    if (!made.hidden && value !== made.dataset.before) values[made.dataset.key] = value;
  }
  return values;
}

async function startVerification() {
  const button = $('verify-start'), { running, next_recording } = verification;
  if (running && !next_recording && !await sure(`Begin anew, without what was measured (${running})?`)) return;
  const values = running && next_recording ? {} : valuesOf('verify-form');
  if (!Object.keys(values).length || await ask('set', values, button)) {
    await ask('verify_start', {}, button);
    readSetup();
  }
}

export function showVerification(now) {
  verification = now;
  const { running, next_recording, verdict, title, figures } = now;
  text('course', running);
  text('verdict', title);
  text('verdict-figures', figures);
  $('verdict').hidden = !verdict;
  $('verdict').className = 'figure ' + ({ pass: 'good', fail: 'bad' }[verdict] || '');
  $('verify-result').disabled = !running;
  $('verify-start').textContent = !running ? 'Start' : next_recording ? 'Next recording' : 'Begin anew';
}

$('verify-form').addEventListener('submit', event => event.preventDefault());
$('verify-start').addEventListener('click', startVerification);
$('verify-result').addEventListener('click', () => ask('verify_result', {}, $('verify-result')));
$('setup-form').addEventListener('submit', event => event.preventDefault());
$('setup-open').addEventListener('toggle', () => $('setup-open').open && readSetup());
$('choose').addEventListener('click', () => {
  $('setup-open').open = true;
  $('setup-card').scrollIntoView();
});
for (const name of ['open', 'continue']) {
  $(name).addEventListener('click', async () => {
    // the last used one is the first of the list
    const { value } = name === 'open' ? $('sessions') : $('sessions').options[0];
    await ask('open', { session: value }, $(name));
    readSetup();
  });
}
for (const radio of document.querySelectorAll('[name=mode]')) {
  radio.addEventListener('change', () => ask('set', { 'sampling.mode': radio.value }, radio));
}
