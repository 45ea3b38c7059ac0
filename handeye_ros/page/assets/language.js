'use strict';
// The sentences of the page in other languages, by their English text: a file each, such as
// de.js. What the node says is translated where PATTERNS know it; else it stays as it is in the
// services, the log and the documentation.

const SENTENCES = {}, PATTERNS = {};
let language = localStorage.getItem('language') || 'en';

// Return a sentence of the page, {0}, {1} ... filled in.
function label(english, ...values) {
  const sentence = (SENTENCES[language] || {})[english] || english;
  return sentence.replace(/\{(\d)\}/g, (_, k) => values[k]);
}

// Return what the node says.
function said(english) {
  return (PATTERNS[language] || []).reduce(
    (sentence, [pattern, other]) => sentence.replace(pattern, other), english);
}

function translate() {
  document.documentElement.lang = language;
  for (const made of document.querySelectorAll('[data-label]')) {
    made.dataset.label = made.dataset.label || made.textContent;
    made.textContent = label(made.dataset.label);
  }
}
