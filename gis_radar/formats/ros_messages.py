"""The ROS messages that carry radar, and what they hold where a bag does not say."""

from __future__ import annotations

from typing import Any

CLOUD = "sensor_msgs/msg/PointCloud2"
# Messages that list their detections one by one: where, and of which type.
LISTS = {
    "radar_msgs/msg/RadarScan": ("returns", "radar_msgs/msg/RadarReturn"),
    "continental_msgs/msg/ContinentalArs548DetectionList": (
        "detections",
        "continental_msgs/msg/ContinentalArs548Detection",
    ),
}
# Messages that carry datagrams as they came.
PACKETS = (
    "nebula_msgs/msg/NebulaPackets",
    "nebula_msgs/msg/NebulaPacket",
    "udp_msgs/msg/UdpPacket",
    "ethernet_msgs/msg/Packet",
    "std_msgs/msg/UInt8MultiArray",
)
KNOWN = (CLOUD, *LISTS, *PACKETS)
# ROS 2 bags up to Humble do not say what their messages hold.
DEFINITIONS = {
    "radar_msgs/msg/RadarReturn": "float32 range\nfloat32 azimuth\nfloat32 elevation\n"
    "float32 doppler_velocity\nfloat32 amplitude",
    "radar_msgs/msg/RadarScan": "std_msgs/Header header\nradar_msgs/RadarReturn[] returns",
    "nebula_msgs/msg/NebulaPacket": "builtin_interfaces/Time stamp\nuint8[] data",
    "nebula_msgs/msg/NebulaPackets": "std_msgs/Header header\nnebula_msgs/NebulaPacket[] packets",
    "udp_msgs/msg/UdpPacket": "std_msgs/Header header\nstring address\nuint16 src_port\n"
    "uint8[] data",
    "continental_msgs/msg/ContinentalArs548Detection": "float32 azimuth_angle\n"
    "float32 azimuth_angle_std\nbool invalid_distance\nbool invalid_distance_std\n"
    "bool invalid_azimuth\nbool invalid_azimuth_std\nbool invalid_elevation\n"
    "bool invalid_elevation_std\nbool invalid_range_rate\nbool invalid_range_rate_std\n"
    "float32 elevation_angle\nfloat32 elevation_angle_std\nfloat32 range\nfloat32 range_std\n"
    "float32 range_rate\nfloat32 range_rate_std\nint8 rcs\nuint16 measurement_id\n"
    "uint8 raw_positive_predictive_value\nuint8 classification\n"
    "uint8 raw_multi_target_probability\nuint16 object_id\nuint8 raw_ambiguity_flag",
    "continental_msgs/msg/ContinentalArs548DetectionList": "std_msgs/Header header\n"
    "uint8 stamp_sync_status\ngeometry_msgs/Point origin_pos\nfloat32 origin_pitch\n"
    "float32 origin_pitch_std\nfloat32 origin_yaw\nfloat32 origin_yaw_std\n"
    "float32 ambiguity_free_velocity_min\nfloat32 ambiguity_free_velocity_max\n"
    "float32 alignment_azimuth_correction\nfloat32 alignment_elevation_correction\n"
    "uint8 alignment_status\ncontinental_msgs/ContinentalArs548Detection[] detections",
}


def typestore(connection: Any) -> Any:
    """Return what the messages of a topic hold: as the bag describes it, else as is usual.

    Parameters
    ----------
    connection : rosbags.interfaces.Connection
        A topic of a bag.

    Returns
    -------
    rosbags.typesys.store.Typestore
        Knows the topic's type and all in it.
    """
    from rosbags.interfaces import MessageDefinitionFormat as Described  # noqa: PLC0415
    from rosbags.typesys import (  # noqa: PLC0415
        Stores,
        get_types_from_idl,
        get_types_from_msg,
        get_typestore,
    )

    definition = connection.msgdef
    if definition.format == Described.NONE:
        store = get_typestore(Stores.ROS2_HUMBLE)
        for name, text in DEFINITIONS.items():
            store.register(get_types_from_msg(text, name))
        return store
    store = get_typestore(Stores.EMPTY)
    if definition.format == Described.MSG:
        store.register(get_types_from_msg(definition.data, connection.msgtype))
    else:
        store.register(get_types_from_idl(definition.data))
    return store
