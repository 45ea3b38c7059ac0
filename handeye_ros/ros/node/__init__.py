"""The node: streams, services, messages."""

OFFERED = (
    'intake.LATCHED_TREE', 'intake.STREAM', 'intake.TFMessage', 'intake.THROTTLE',
    'live.LiveSession', 'publishers.LATCHED', 'publishers.cloud', 'publishers.pose_stamped',
    'publishers.time_message', 'publishers.transform_stamped', 'state.State', 'streams.Current',
)
