"""The node: streams, services, messages."""

OFFERED = (
    'intake.STREAM', 'intake.TFMessage', 'intake.THROTTLE', 'live.LiveSession',
    'publishers.LATCHED', 'publishers.cloud', 'publishers.transform_stamped', 'state.State',
    'streams.Current',
)
