"""One HTML file that shows an answer to a person."""

OFFERED = (
    'evidence.Evidence', 'evidence.StopSnapshot', 'evidence.config_of', 'evidence.judged',
    'evidence.recording_of', 'evidence.use_config', 'figures.style', 'page', 'page.templates',
    'scene.in_sensor', 'evidence.stated_noise',
)
