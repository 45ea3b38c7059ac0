"""
The ROS side: the only room that imports ROS or reads bags.

Its modules are executables, and code for the rooms below.
"""

OFFERED = (
    'errors.AllMalformedError', 'errors.MessageError', 'errors.NoTopicError',
    'errors.NothingToSaveError', 'errors.PageError', 'errors.SessionError',
    'errors.TopicTypeError', 'errors.TopicsError', 'errors.WorkerEndedError',
    'executable.InvalidHandle', 'executable.RCLError', 'executable.UNSENDABLE',
    'executable.exit_code', 'executable.offer', 'executable.ros', 'executable.spin',
    'replay.replay',
)
