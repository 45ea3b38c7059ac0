"""Starts the node: ros2 launch handeye_ros calibrate.launch.py params_file:=my_cell.yaml."""
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the node with its parameter file."""
    plate = PathJoinSubstitution([FindPackageShare('handeye_ros'), 'config', 'plate.yaml'])
    use_sim_time = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value=plate,
                              description='parameters of the node; config/ holds examples'),
        DeclareLaunchArgument('use_sim_time', default_value='false',
                              description='take the time from /clock'),
        Node(package='handeye_ros', executable='calibrate', name='handeye', output='screen',
             # a file that says what the time is must not be overruled by a default
             parameters=[{'use_sim_time': use_sim_time}, LaunchConfiguration('params_file')]),
    ])
