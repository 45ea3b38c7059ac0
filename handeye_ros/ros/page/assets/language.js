'use strict';
// The labels of the page in other languages, by their English text. What the node says stays
// English: it is the text of the services, the log and the documentation.

const LABELS = {
  de: {
    'Connect': 'Verbinden', 'Samples': 'Messungen', 'Answer': 'Ergebnis', 'Save': 'Speichern',
    'Now': 'Jetzt', 'What to do next': 'Nächster Schritt', 'taken': 'gemessen', 'next': 'nächste',
    'target': 'Zielkörper', 'Details (1 sigma)': 'Einzelheiten (1 Sigma)', 'value': 'Wert',
    'Take': 'Messen', 'Undo': 'Zurück', 'Compute': 'Berechnen', 'Clear': 'Alles löschen',
    'No, keep them': 'Nein, behalten', 'Yes': 'Ja', 'Sound': 'Ton', 'Standing still.': 'Steht still.',
    'Moving.': 'In Bewegung.', 'The feature is seen.': 'Das Merkmal ist im Bild.',
    'Leave out': 'Weglassen', 'Bring back': 'Zurückholen', 'Enough samples': 'Genug Messungen',
    'none yet': 'noch keines', 'current': 'aktuell',
    'outdated: samples or settings have changed since':
      'veraltet: Messungen oder Einstellungen haben sich geändert',
    'withdrawn: there is no answer any more': 'zurückgezogen: es gibt kein Ergebnis mehr',
    'Nothing yet.': 'Noch nichts.', 'left out': 'weggelassen', 'not used by the fit':
      'von der Ausgleichung nicht benutzt',
  },
};
let language = localStorage.getItem('language') || 'en';

function label(english) {
  return (LABELS[language] || {})[english] || english;
}

function translate() {
  document.documentElement.lang = language;
  for (const made of document.querySelectorAll('[data-label]')) {
    made.textContent = label(made.dataset.label);
  }
}
