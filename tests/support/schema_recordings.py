"""Recordings that together use every field of ``recording.toml``."""

from __future__ import annotations

from sensor_files import SERIALS

from rtof_kin.body.skeleton import SkeletonModel

LINES = """
    width_px = 1920
    height_px = 1080
"""
AIMED = f"{LINES}focal_px = 1250.0\nposition_m = [4.0, 0.6, 1.5]\ntarget_m = [0.0, 0.0, 1.0]\n"
MATRICES = f"""{LINES}
    K = [[1250, 0, 960.0], [0, 1250, 540], [0, 0, 1]]
    R_camera_world = [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]
    t_camera_world_m = [0.0, 1.0, 4.0]
"""
SENSORS = """
    [imus.sensors.L_UpArm]
    quat_wxyz_world_inertial = [1, 0, 0, 0]
    R_sensor_bone = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    [imus.sensors.strap]
    joint = "RightLeg"
    lever_arm_m = [0.05, 0.0, -0.16]
    R_world_inertial = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    quat_wxyz_sensor_bone = [1, 0, 0, 0]
    mounting_sd_deg = 6.0
"""
JOINTS = SkeletonModel.default().names
OFFSETS = "\n".join(f"{name} = [0.01, 0.02, 0.2]" for name in JOINTS[1:])
RECORDINGS = {
    "everything": f"""
    schema_version = 1
    name = "walk"
    first_frame = 3
    [session]
    subject = "P07"
    operator = "A"
    date = "2026-01-31"
    place = "here"
    protocol = "walk"
    [scene]
    floor_height_m = 0.0
    [camera]
    {AIMED}
    principal_point_px = [960.0, 540.0]
    distortion = [0, 0, 0, 0, 0]
    assumed = ["pose"]
    stabilised = true
    heading_drift_deg_s = 0.01
    uncertainty = {{focal = 0.1, tilt_deg = 5, roll_deg = 1.0, height_m = 0.02, k1 = 0.05, of_motion = true}}
    accuracy = {{focal = 0.004, tilt_deg = 0.3, roll_deg = 0.2, height_m = 0.01, k1 = 0.01}}
    [keypoints]
    file = "keypoints.npz"
    rate_hz = 60.0
    start_s = 0.5
    layout = "joints"
    [[views]]
    [views.camera]
    {MATRICES}
    [views.keypoints]
    file = "keypoints.npz"
    rate_hz = 60
    start_s = 0.5
    landmarks = {list(JOINTS)}
    [imus]
    file = "imus.npz"
    rate_hz = 60.0
    start_s = 0.4
    clock_drift = 1e-5
    names = ["L_UpArm", "strap"]
    {SENSORS}
    [truth]
    file = "truth.npz"
    [notes]
    acknowledgement = "Data by nobody."
    text = "-"
    """,
    "counted from 0": """
    schema_version = 1
    [camera]
    file = "cameras.toml"
    name = "a"
    [keypoints]
    file = "keypoints.npz"
    layout = "joints"
    rate_hz = 60
    person = 0
    """,
    "a person": """
    schema_version = 1
    [subject]
    height_m = 1.8
    mass_kg = 70.0
    sex = "male"
    [skeleton]
    table = "total_capture"
    bone_lengths_m = {LeftLeg = 0.41}
    [posture.quat_wxyz]
    Spine1 = [1.0, 0, 0, 0]
    [imus]
    file = "imus.npz"
    rate_hz = 60.0
    names = ["a", "b"]
    """,
    "files of others": f"""
    schema_version = 1
    [camera]
    file = "cameras.toml"
    name = "a"
    up = "z"
    metres_per_unit = 1.0
    motion = {{file = "gyro.csv", sensor = "phone", held = "portrait"}}
    [keypoints]
    file = "keypoints.npz"
    layout = "joints"
    rate_hz = 60
    person_number = 1
    frame = 1
    [imus]
    file = "trial"
    rate_hz = 60.0
    first_sample_s = 0.0
    acceleration_unit = "m/s2"
    gravity = "included"
    acceleration_axes = "sensor"
    angular_unit = "rad/s"
    quaternion_order = "wxyz"
    orientation_maps = "sensor to inertial"
    inertial_axes = "z up"
    [imus.map]
    {SERIALS[0]} = "pelvis"
    """,
    "sensors alone": f"""
    schema_version = 1
    [skeleton.joint_offsets_m]
    {OFFSETS}
    [imus]
    file = "imus.csv"
    start_s = 0.0
    {SENSORS}
    """,
    "a map of sensors": """
    schema_version = 1
    [imus]
    file = "trial"
    sensor_map = "places.csv"
    """,
    "a camera's matrices": f"""
    schema_version = 1
    [camera]
    {MATRICES}
    motion = {{file = "turning.npz", start_s = 0.0}}
    [keypoints]
    file = "keypoints.npz"
    rate_hz = 60
    landmarks = {list(JOINTS)}
    """,
    "points in a .csv": f"""
    schema_version = 1
    [camera]
    {AIMED}
    [keypoints]
    file = "keypoints.csv"
    [imus]
    {SENSORS}
    """,
}
