"""Sessions on the disk: a bag with one complete file for each event."""

OFFERED = (
    'joints.joints_of', 'joints.source_of_session', 'reading.Stored', 'reading.is_session',
    'reading.read_session', 'resume.resumed', 'store.Place', 'store.Store',
    'writing.SessionStore',
)
