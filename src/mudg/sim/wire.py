"""Messages of AlpaSim's SensorsimService and EgodriverService: names, numbers and types of their fields, as the public
interface has them (alpasim_grpc v0, NVIDIA, Apache-2.0). The messages are built from the table below when a service is
first used, in a pool of their own, so that a client's generated classes may live beside them."""

from __future__ import annotations

import functools
import importlib
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import ResourceError, UsageError
from mudg.base.types import Camera

SERVICES: Final = tuple(f"{at}sensorsim.SensorsimService" for at in ("nre.grpc.protos.", "nurec.grpc.protos.", ""))
"""Full names under which simulators of different years call the same service."""
DRIVER: Final = "egodriver.EgodriverService"
HEALTH: Final = "grpc.health.v1.Health"
PNG, JPEG, RGB_PLANAR = 1, 2, 4
_SHUTTERS: Final = ("global", "top_to_bottom", "left_to_right", "bottom_to_top", "right_to_left", "global")
SHUTTERS: Final = dict(enumerate(_SHUTTERS))
"""Numbers of ``CameraSpec.shutter_type`` -> our names."""
MESSAGES: Final = {
    "Empty": "",
    "Vec3": "float x 1, float y 2, float z 3",
    "Quat": "float w 1, float x 2, float y 3, float z 4",
    "Pose": "Vec3 vec 1, Quat quat 2",
    "PoseAtTime": "Pose pose 1, fixed64 timestamp_us 2",
    "Trajectory": "*PoseAtTime poses 1",
    "ApiVersion": "uint32 major 1, uint32 minor 2, uint32 patch 3",
    "VersionId": "string version_id 1, string git_hash 2, ApiVersion grpc_api_version 3",
    "AvailableScenesReturn": "*string scene_ids 1",
    "LoadedScene": "string scene_id 1, uint64 loaded_instance_count 2, uint64 reusable_instance_count 3",
    "LoadedScenesReturn": "*LoadedScene scenes 1, uint64 loaded_instance_capacity 2",
    "EgoMaskId": "string camera_logical_id 1, string rig_config_id 2",
    "EgoMask": "EgoMaskId ego_mask_id 1",
    "AvailableEgoMasksReturn": "*EgoMask ego_mask_metadata 1",
    "LinearCde": "double linear_c 1, double linear_d 2, double linear_e 3",
    "FthetaParam": "double principal_point_x 1, double principal_point_y 2, int32 reference_poly 3, "
    "*double pixeldist_to_angle_poly 4, *double angle_to_pixeldist_poly 5, double max_angle 6, LinearCde linear_cde 7",
    "PinholeParam": "double principal_point_x 1, double principal_point_y 2, double focal_length_x 3, "
    "double focal_length_y 4, *double radial_coeffs 5, *double tangential_coeffs 6, *double thin_prism_coeffs 7",
    "FisheyeParam": "double principal_point_x 1, double principal_point_y 2, double focal_length_x 3, "
    "double focal_length_y 4, *double radial_coeffs 5, double max_angle 6",
    "WindshieldParam": "int32 reference_poly 1",
    "CameraSpec": "FthetaParam ftheta_param 2, PinholeParam opencv_pinhole_param 3, "
    "FisheyeParam opencv_fisheye_param 4, string logical_id 5, uint32 resolution_h 7, uint32 resolution_w 8, "
    "int32 shutter_type 9, WindshieldParam bivariate_windshield_model_param 10",
    "PosePair": "Pose start_pose 1, Pose end_pose 2",
    "DynamicObject": "string track_id 1, PosePair pose_pair 2",
    "RGBRenderRequest": "string scene_id 1, uint32 resolution_h 2, uint32 resolution_w 3, "
    "CameraSpec camera_intrinsics 4, fixed64 frame_start_us 5, fixed64 frame_end_us 6, PosePair sensor_pose 7, "
    "*DynamicObject dynamic_objects 8, int32 image_format 9, float image_quality 10, bool insert_ego_mask 11, "
    "EgoMaskId ego_mask_id 12",
    "RGBRenderReturn": "bytes image_bytes 1",
    "SceneRequest": "string scene_id 1",
    "AvailableCamera": "CameraSpec intrinsics 1, Pose rig_to_camera 2, string logical_id 3",
    "AvailableCamerasReturn": "*AvailableCamera available_cameras 1",
    "AvailableTrajectory": "Trajectory trajectory 2",
    "AvailableTrajectoriesReturn": "*AvailableTrajectory available_trajectories 1",
    "LidarSpec": "int32 lidar_type 2",
    "LidarRenderRequest": "string scene_id 1, LidarSpec lidar_config 2, fixed64 frame_start_us 3, "
    "fixed64 frame_end_us 4, PosePair sensor_pose 5, *DynamicObject dynamic_objects 6",
    "LidarRenderReturn": "*float point_xyzs 1, *float point_intensities 2, uint32 num_points 3, "
    "bytes point_xyzs_buffer 4, bytes point_intensities_buffer 5",
    "BatchItem": "string camera_name 1, RGBRenderRequest request 2",
    "BatchRGBRenderRequest": "*BatchItem items 1",
    "BatchReply": "string camera_name 1, RGBRenderReturn result 2, bool success 3, string error_message 4",
    "BatchRGBRenderReturn": "*BatchReply items 1",
    "AggregatedRenderRequest": "*RGBRenderRequest rgb_requests 1, *LidarRenderRequest lidar_requests 2",
    "AggregatedRenderReturn": "*RGBRenderReturn rgb_returns 1, *LidarRenderReturn lidar_returns 2, bytes driver_data 3",
    "DynamicState": "Vec3 angular_velocity 1, Vec3 linear_velocity 2, Vec3 linear_acceleration 3",
    "VehicleDefinition": "*AvailableCamera available_cameras 3",
    "RolloutSpec": "VehicleDefinition vehicle 1",
    "DriveScene": "string scene_id 1",
    "DriveSessionRequest": "string session_uuid 1, fixed64 random_seed 2, DriveScene debug_info 4, "
    "RolloutSpec rollout_spec 5",
    "DriveSessionCloseRequest": "string session_uuid 1",
    "CameraImage": "fixed64 frame_start_us 2, fixed64 frame_end_us 3, bytes image_bytes 4, string logical_id 5",
    "RolloutCameraImage": "string session_uuid 1, CameraImage camera_image 3",
    "RolloutEgoTrajectory": "string session_uuid 1, Trajectory trajectory 3, *DynamicState dynamic_states 5",
    "Route": "*Vec3 waypoints 1, fixed64 timestamp_us 2",
    "RouteRequest": "string session_uuid 1, Route route 3",
    "DriveRequest": "string session_uuid 1, fixed64 time_now_us 3, fixed64 time_query_us 4",
    "DriveResponse": "Trajectory trajectory 2, bool terminate_session 4",
    "HealthRequest": "string service 1",
    "HealthReply": "int32 status 1",
}
"""Messages and their fields ``type name number``; ``*``: repeated. Enumerations are int32 here: the same bytes."""
METHODS: Final = {
    "render_rgb": ("RGBRenderRequest", "RGBRenderReturn"),
    "render_lidar": ("LidarRenderRequest", "LidarRenderReturn"),
    "render_aggregated": ("AggregatedRenderRequest", "AggregatedRenderReturn"),
    "batch_render_rgb": ("BatchRGBRenderRequest", "BatchRGBRenderReturn"),
    "get_version": ("Empty", "VersionId"),
    "get_available_scenes": ("Empty", "AvailableScenesReturn"),
    "get_loaded_scenes": ("Empty", "LoadedScenesReturn"),
    "get_available_cameras": ("SceneRequest", "AvailableCamerasReturn"),
    "get_available_trajectories": ("SceneRequest", "AvailableTrajectoriesReturn"),
    "get_available_ego_masks": ("Empty", "AvailableEgoMasksReturn"),
}

DRIVER_METHODS: Final = {
    "get_version": ("Empty", "VersionId"),
    "start_session": ("DriveSessionRequest", "Empty"),
    "close_session": ("DriveSessionCloseRequest", "Empty"),
    "submit_image_observation": ("RolloutCameraImage", "Empty"),
    "submit_egomotion_observation": ("RolloutEgoTrajectory", "Empty"),
    "submit_route": ("RouteRequest", "Empty"),
    "drive": ("DriveRequest", "DriveResponse"),
}


def package() -> Any:
    """The module ``grpc``. ResourceError: it is not installed."""
    try:
        return importlib.import_module("grpc")
    except ImportError as error:
        what = "the simulator's server needs grpcio and protobuf, which are not installed"
        raise ResourceError(what, remedy="pip install 'mudg[sim]'") from error


@functools.cache
def messages() -> SimpleNamespace:
    """Classes of the messages, by name."""
    package()
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="mudg/sensorsim.proto", package="mudg.sensorsim", syntax="proto3")
    for name, fields in MESSAGES.items():
        message = file.message_type.add(name=name)
        for text in filter(None, fields.split(", ")):
            kind, field, number = text.split()
            repeated, kind = kind.startswith("*"), kind.removeprefix("*")
            own = message.field.add(name=field, number=int(number))
            own.label = kinds.LABEL_REPEATED if repeated else kinds.LABEL_OPTIONAL
            own.type = kinds.TYPE_MESSAGE if kind in MESSAGES else getattr(kinds, f"TYPE_{kind.upper()}")
            if kind in MESSAGES:
                own.type_name = f".mudg.sensorsim.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    find = pool.FindMessageTypeByName
    return SimpleNamespace(**{n: message_factory.GetMessageClass(find(f"mudg.sensorsim.{n}")) for n in MESSAGES})


def pose_of(matrix: NDArray[np.float64]) -> Any:
    """The message ``Pose`` of a rigid f64[4, 4]."""
    types, (w, x, y, z) = messages(), geometry.quaternion_from_matrix(matrix)
    place = types.Vec3(x=matrix[0, 3], y=matrix[1, 3], z=matrix[2, 3])
    return types.Pose(vec=place, quat=types.Quat(w=w, x=x, y=y, z=z))


def available_camera(camera: Camera, mount: NDArray[np.float64]) -> Any:
    """The message ``AvailableCamera`` of a rectified camera; ``mount``: vehicle-from-camera f64[4, 4]."""
    types, (fx, fy, cx, cy) = messages(), camera.intrinsics
    lens = types.PinholeParam(focal_length_x=fx, focal_length_y=fy, principal_point_x=cx, principal_point_y=cy)
    size = {"resolution_h": camera.height, "resolution_w": camera.width}
    spec = types.CameraSpec(opencv_pinhole_param=lens, logical_id=camera.name, shutter_type=5, **size)
    return types.AvailableCamera(intrinsics=spec, rig_to_camera=pose_of(mount), logical_id=camera.name)


def matrix_of(pose: Any, where: str) -> NDArray[np.float64]:
    """f64[4, 4] of a pose on the wire; float32 quaternions are brought to length 1. UsageError: not finite, or a
    quaternion far from length 1."""
    quaternion = np.array([pose.quat.w, pose.quat.x, pose.quat.y, pose.quat.z])
    place, length = np.array([pose.vec.x, pose.vec.y, pose.vec.z]), float(np.linalg.norm(quaternion))
    if not (np.isfinite(place).all() and 0.99 < length < 1.01):
        got = f"place {place.tolist()}, quaternion {quaternion.tolist()}"
        raise UsageError("a pose is not rigid", where=where, expected="finite numbers, a unit quaternion", got=got)
    return geometry.from_rotation_translation(geometry.matrix_from_quaternion(quaternion / length), place)
