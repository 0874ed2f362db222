"""The scene directory: writer and reader of prepared driving logs.

    scene.json                       schema version, cameras, frames, sweeps, ego path, split, source and licence
    tracks.json                      tracked boxes
    images/CAM/000000.png|jpg        recorded images (rectified, 8-bit RGB)
    lidar/SENSOR/000000.safetensors  xyz f32[N, 3] metres in the LiDAR frame, intensity f32[N] 0..1, dt_s f32[N];
                                     classes u8[N] where people labelled the points
    labels/NAME/CAM/000000.*         see ``read_label``
    manifest.json                    sha256 of every file; checked at each read where it is there

The writer builds the tree beside its destination and moves it into place at ``finish``: a scene is there completely or
not at all.
"""
