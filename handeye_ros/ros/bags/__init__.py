"""
Recordings: their storage, and conversion of ROS messages to profiles and poses.

Reads mcap and db3 in one pass, also truncated or damaged files; writes bags in the layouts of
drivers.
"""

OFFERED = (
    'bag', 'bag.Recording', 'bag.evidence', 'bag.flow', 'bag.read', 'bag.read_poses',
    'bag.read_with_joints', 'bag_write', 'bag_write.cloud_cdr', 'bag_write.joints_cdr',
    'bag_write.pose_cdr', 'bag_write.string_cdr', 'bag_write.write_path', 'contents.CLOUD',
    'contents.JOINTS', 'contents.POSE', 'contents.Raw', 'contents.STRING', 'contents.full_name',
    'messages.deserialised', 'messages.pose_from_cdr', 'messages.pose_from_stamped',
    'messages.typestore', 'poses.PoseTable', 'poses.joints_and_pose', 'poses.pose_from_joints',
    'profile_reader.ProfileReader', 'profile_reader.returns_of', 'profile_reader.split',
    'storage.scan', 'transforms.FlangeTracker',
)
