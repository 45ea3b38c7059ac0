"""Sessions on the disk: a bag with one complete file for each event."""

OFFERED = (
    'reading.Stored', 'reading.is_session', 'reading.joints_of', 'reading.read_session',
    'reading.sessions_in', 'reading.source_of_session', 'store.OutputFolders', 'store.Store',
    'store.resumed', 'writing.SessionStore',
)
