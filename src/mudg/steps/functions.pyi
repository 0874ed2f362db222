"""Generated: `MUDG_UPDATE_FROZEN=1 pytest tests/house`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

def annotate(
    scene: str | Path,
    *,
    out: str | Path,
    overwrite: bool = False,
    config: str | Path | None = None,
    labeller: Literal['embedded', 'network'] = 'embedded',
    weights: str = '',
    depth: bool = True,
    depth_network: str = '',
    depth_steps: int = 0,
    device: str = 'auto',
    sweeps: int = 6,
    dynamic: bool = True,
    ego: bool = False,
    processes: int = 0,
) -> Any:
    """Add missing labels to a scene: semantics, sky and depth, with confidences.

    Args:
        scene: Scene directory written by ingest, or folder of mudg run.
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        config: YAML file of settings, read before those given here.
        labeller: Source of classes and sky. embedded: the small shipped network, from image, heights and boxes. network: a segmentation network from `weights`.
        weights: labeller network: folder of a SegFormer or Mask2Former with Cityscapes classes in the transformers format. labeller embedded: folder of a network trained with tools/train_segmenter.py (empty = the shipped network).
        depth: Write dense depth, by default from the LiDAR points of several sweeps, filled with the image as guide.
        depth_network: Take dense depth from a network and align it to LiDAR: folder of a PromptDepthAnything or Depth Anything model (transformers), or of a DepthLab written by mudg convert.
        depth_steps: DepthLab: denoising steps (0 = as in the model folder).
        device: Device of the networks of labeller and `depth_network`: auto (CUDA if there is one), cpu, cuda, cuda:N, mps.
        sweeps: Number of sweeps per LiDAR, nearest in time, whose points are merged for dense depth.
        dynamic: Write masks of dynamic objects, from the tracked boxes.
        ego: Write masks of the own vehicle: pixels at the bottom of the image that stay the same while it drives. Use it if the bonnet is visible.
        processes: Number of frames labelled at the same time (0 = one per core; one if a pretrained network computes on another device).
    """
    ...

def bench(
    name: str,
    sources: tuple[str | Path, ...] = (),
    *,
    out: str | Path,
    overwrite: bool = False,
    preset: Literal['fast', 'default', 'quality', 'paper'] = 'default',
    config: str | Path | None = None,
    model: str = 'embedded',
    precision: Literal['auto', 'float32', 'bfloat16', 'float16'] = 'auto',
    seed: int = 0,
    list: Literal['development', 'reported'] = 'development',
    logs: int = 8,
    methods: tuple[str, ...] = ('nearest_fill', 'gs3d', 'street_gaussians', 'mudg_r', 'mudg_s'),
    iterations: int = 1000,
    guided_share: float = 1.5,
    processes: int = 0,
    videos: bool = True,
    table: Literal['mudg1', 'mudg2', 'mudg3', 'recondreamer', 'drivedreamer4d', 'streetcrafter', 'freesim', 'recam', 'spvc', 'panda', 'dist'] = 'mudg1',
    protocols: tuple[str, ...] = ('gap', 'camera', 'lidar'),
    shown: tuple[str, ...] = (),
    resolution: str = '',
    frames: str = '',
    device: str = 'auto',
    fuse: Mapping[str, Any] = ...,
    synthesize: Mapping[str, Any] = ...,
    fit: Mapping[str, Any] = ...,
    score: Mapping[str, Any] = ...,
) -> Any:
    """Run a benchmark: shift or loop against exact truth, real on real logs, paper for tables of papers.

    Args:
        name: Benchmark to run: shift (complete methods off the recorded path), loop (drives in fitted scenes), real (complete methods on real logs) or paper (a table of a paper).
        sources: real, paper: folders of dataset logs, or scenes made by ingest. paper also takes city:reported or city:development, a list of generated cities.
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        preset: Settings of clouds, generated views and fits to start from, as for mudg run (docs/presets.md). paper: the published set-up, with a published-type model.
        config: YAML file of settings, read before those given here.
        model: Diffusion model: "embedded" or "embedded-tiny", both shipped with the package, or a model folder written by learn or convert.
        precision: Number format of the diffusion model. auto: bfloat16 on CUDA devices and CPUs that compute in it, float32 elsewhere. float16: published-type models on CUDA devices.
        seed: Seed of all random numbers; the same seed gives the same result.
        list: shift, loop: list of logs. Choose settings on development; report results on reported, on which nothing was chosen.
        logs: shift, loop; paper with a list of cities: number of logs taken from the list, 1 to 8 (the development list has 4).
        methods: Methods to compare: those of the default (loop: street_gaussians and mudg_s); pvg, s3gaussian, bezier, omnire, emernerf and difix; and street_gaussians-longer, which goes on until it has as many steps as mudg_s, without generated views. Also mudg_f, renders of mudg_s that the diffusion model repairs. paper: any of these but mudg_f; with the default, all of them.
        iterations: Optimisation steps of every fit without virtual views.
        guided_share: Steps of fits under virtual views, as a multiple of the others'.
        processes: Number of logs (real: also ways of hiding frames) processed at the same time, with one thread each (0 = one per core). Results do not depend on it.
        videos: shift, paper: also write videos of all methods side by side.
        table: paper: the table to fill (docs/paper_tables.md).
        protocols: real: protocols, out of the three of the default. Instead of gap also gap-1, gap-3 and gap-5 alone.
        shown: real: cameras that the methods see in protocol camera; the first one gives the views beside the recorded path (empty = front, or the first camera).
        resolution: real, paper: image size of logs that are imported, as for ingest (empty = as recorded; paper: as the table says). paper with a list of cities: WIDTHxHEIGHT (empty = 384x256).
        frames: real, paper: frames of logs that are imported, FIRST:END without END itself, as for ingest (empty = all; paper: as the table says). paper with a list of cities: 0:END (empty = 0:24).
        device: Device of all steps: auto (CUDA if there is one), cpu, cuda, cuda:N.
        fuse: How the clouds of every log are made.
        synthesize: How views are generated. Model, number format, seed and device are the benchmark's own flags; where views are generated is the benchmark's matter (real: `--synthesize.shifts-m` for the views that fits learn from).
        fit: How scenes are fitted. Method, steps, seed and device are the benchmark's own flags.
        score: paper: how every row is scored; files of weights are given here.
    """
    ...

def convert(
    checkpoint: str | Path,
    *,
    to: str | Path,
    overwrite: bool = False,
    config: str | Path | None = None,
    network: Literal['diffusion', 'inception', 'i3d', 'lpips', 'lpips-vgg'] = 'diffusion',
    resolution: Literal['auto', '320x512', '576x1024'] = 'auto',
    dtype: Literal['keep', 'float32', 'float16', 'bfloat16'] = 'keep',
    memory_gb: float = 0.0,
) -> Any:
    """Convert a published checkpoint to a folder for synthesize, annotate or score.

    Args:
        checkpoint: Checkpoint file of MuDG, DynamiCrafter-512 or DynamiCrafter-1024 (.ckpt, .pt or .safetensors); or, for DepthLab, the folder that contains DepthLab's files, Marigold's folder and the image encoder's folder; or, with --network, weights of a network of the scores.
        to: Model folder to write.
        overwrite: Replace the model that --to already holds. The old model stays until the new one is finished, so the disk must hold both. Files that do not belong to the model are kept.
        config: YAML file of settings, read before those given here.
        network: What the checkpoint holds: a diffusion model, or a network of the scores (docs/scores.md). The other settings apply to diffusion models only.
        resolution: Image height x width that the checkpoint was trained at. auto: from 512 or 1024 in the file's name.
        dtype: Number format of the written weights. keep: as in the checkpoint. bfloat16 halves the size of float32 weights.
        memory_gb: Limit, in GB, of the address space of the process that reads the checkpoint, beyond the program's own (0 = derived from the file's size). Raise it if the conversion runs out of memory.
    """
    ...

def dataset(
    format: str,
    runs: tuple[str | Path, ...],
    *,
    out: str | Path,
    overwrite: bool = False,
    val: tuple[str | Path, ...] = (),
    scene: str | Path | None = None,
    edits: str | Path | None = None,
    path: str | Path | None = None,
    config: str | Path | None = None,
    cameras: tuple[str, ...] = (),
    shifts_m: tuple[float, ...] = (0.0,),
    every: int = 1,
    width_px: int = 0,
    fov_deg: float = 0.0,
    lidar: str = '',
    least_pixels: int = 25,
    farthest_seen_deg: float = 180.0,
    device: str = 'auto',
) -> Any:
    """Write labelled images of reconstructions as a data set: kitti, kitti-tracking, coco, nuscenes or py123d.

    Args:
        format: kitti: images, calibration and 3D boxes as in KITTI's object benchmark. kitti-tracking: the same by sequence, with track ids and poses. coco: instances with masks, and panoptic segmentation. nuscenes: all tables and images of a release, every path a scene. py123d: Arrow logs of 123D.
        runs: Folders of finished mudg runs, or of a fit (with --scene). They form the split train.
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        val: More of them, which form the split val.
        scene: Scene directory that a fit belongs to. A run has its own.
        edits: Edit script (docs/edit.md) to carry out before; with one RUN.
        path: Camera path that stands for the shifts, as of mudg render --path; with one RUN.
        config: YAML file of settings, read before those given here.
        cameras: Cameras of the log (empty = all).
        shifts_m: Lateral shifts in metres, positive to the left of the direction of travel; 0 = the recorded path. Several make one data set.
        every: Take every n-th frame.
        width_px: Image width in pixels (0 = as recorded); the height follows.
        fov_deg: Horizontal field of view in degrees (0 = as recorded).
        lidar: Give every view a sweep of this LiDAR, taken at the moment of its image: a sensor of the scene, pandar128, at128, hdl64, vlp16, or a JSON file of beams (docs/simulator.md). Empty: none.
        least_pixels: Leave out objects of which fewer pixels are visible.
        farthest_seen_deg: Leave out objects that are seen from this many degrees or more beside every direction from which the log recorded them: that side of them is guesswork. 60 is strict.
        device: Device: auto (CUDA if there is one), cpu, cuda, cuda:N.
    """
    ...

def demo(
    *,
    out: str | Path = ...,
    overwrite: bool = False,
    preset: Literal['fast', 'default', 'quality', 'paper'] | None = None,
    fast: bool = False,
    seed: int | None = None,
    shifts_m: tuple[float, ...] = (),
    config: str | Path | None = None,
    device: str = 'auto',
    guided_share: float = 1.5,
    ingest: Mapping[str, Any] = ...,
    annotate: Mapping[str, Any] = ...,
    fuse: Mapping[str, Any] = ...,
    synthesize: Mapping[str, Any] = ...,
    fit: Mapping[str, Any] = ...,
    render: Mapping[str, Any] = ...,
    score: Mapping[str, Any] = ...,
) -> Any:
    """Run all steps on the built-in city and write a report page.

    Args:
        out: Folder to write. Repeat the same command to resume an interrupted demo.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        preset: Settings to start from. fast: smaller images, fewer frames and iterations. default: minutes on two cores. quality: 30,000 iterations, millions of Gaussians, for a GPU. paper: the published set-up, with a published-type model (docs/presets.md).
        fast: The same as --preset fast: images of a log 480 pixels wide, 3 m to each side. One to two minutes on 2 cores for the city, or 16 frames of one camera.
        seed: Seed of all random numbers in all steps (not given: city 3 and seed 0, or the values in --config).
        shifts_m: Lateral shifts in metres, positive to the left (not given: 2, 3 and 4 m to both sides; --fast: 3 m). They apply to synthesize, render and score.
        config: YAML file of settings, read before those given here.
        device: Device of all steps: auto (CUDA if there is one), cpu, cuda, cuda:N. A step whose own device is set, as by --fit.device, keeps that one.
        guided_share: Iterations of the fit with virtual views, as a multiple of those of the fit without. Both begin from nothing.
        ingest:
        annotate:
        fuse:
        synthesize:
        fit:
        render:
        score:
    """
    ...

def doctor(
    scene: str | Path | None = None,
) -> Any:
    """Report what this machine offers, or check a scene or log for errors.

    Args:
        scene: Scene directory, folder of mudg run, or log in the custom format, to check (not given: report on this machine).
    """
    ...

def edit(
    source: str | Path,
    script: str | Path,
    *,
    out: str | Path,
    overwrite: bool = False,
    scene: str | Path | None = None,
    fused: str | Path | None = None,
    config: str | Path | None = None,
    raster: Literal['auto', 'cpu', 'torch', 'gsplat'] = 'auto',
    device: str = 'auto',
) -> Any:
    """Change a drive as an edit script says: remove, move, insert, change lanes, weather and light.

    Args:
        source: Gaussian scene written by fit, or folder of a finished mudg run.
        script: Edit script (docs/edit.md).
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        scene: Scene directory that a Gaussian scene was fitted to. With it, the vehicle's path and parked objects can be edited. A run has its own.
        fused: Point clouds written by fuse, for the height of the ground (not given: the Gaussians give it). A run has its own.
        config: YAML file of settings, read before those given here.
        raster: Rasteriser backend. auto picks the fastest one available and prints its name.
        device: Device: auto (CUDA if there is one), cpu, cuda, cuda:N.
    """
    ...

def export(
    format: str,
    source: str | Path,
    *,
    out: str | Path,
    scene: str | Path | None = None,
    edits: str | Path | None = None,
    overwrite: bool = False,
    config: str | Path | None = None,
    time_s: float | None = None,
    nodes: tuple[str, ...] = (),
    axes: Literal['viewer', 'world'] = 'viewer',
    sky: Literal['keep', 'none', 'sphere'] = 'keep',
) -> Any:
    """Write a fitted scene for other programs: PLY, SPZ, glTF, USD, SOG; cameras for nerfstudio and COLMAP.

    Args:
        format: Gaussians: ply, alpasim, spz, glb, usda, usdz, compressed-ply, sog, splat. Cameras: nerfstudio, colmap. The log over time: mcap, ros2, ncore.
        source: Gaussian scene written by fit, or folder of a finished mudg run; for cameras also a scene directory.
        out: File to write, with the suffix of the format; for cameras, ros2 and ncore, folder to write.
        scene: Scene directory that a Gaussian scene was fitted to. A run has its own.
        edits: Edit script (docs/edit.md) to carry out before.
        overwrite: Replace the output if it exists.
        config: YAML file of settings, read before those given here.
        time_s: Moment at which moving objects are taken, on the scene's clock (not given: formats with motion hold all of it, others the middle of the log).
        nodes: Track ids of the objects to write, and background for what stands (not given: everything).
        axes: viewer: axes that programs expect of the format. world: x forward, y left, z up in every format.
        sky: keep: a panorama, in formats that hold one. none: no sky. sphere: 6000 flat Gaussians 300 m away, in every format.
    """
    ...

def export_asset(
    source: str | Path,
    track_id: str,
    *,
    out: str | Path,
    scene: str | Path | None = None,
    overwrite: bool = False,
) -> Any:
    """Write one object of a fitted scene to a file that edit scripts can insert.

    Args:
        source: Gaussian scene written by fit, or folder of a finished mudg run.
        track_id: Track id of a dynamic object.
        out: File to write.
        scene: Scene directory that a Gaussian scene was fitted to; it tells from which sides the object was seen. A run has its own.
        overwrite: Replace the output if it exists.
    """
    ...

def fit(
    scene: str | Path,
    fused: str | Path | None = None,
    *,
    out: str | Path,
    overwrite: bool = False,
    tensorboard: bool = False,
    observations: tuple[str | Path, ...] = (),
    start_from: str | Path | None = None,
    config: str | Path | None = None,
    method: Literal['gs3d', 'street_gaussians', 'pvg', 'omnire', 's3gaussian', 'bezier', 'emernerf', 'difix', 'mudg_s'] = 'mudg_s',
    iterations: int = 2000,
    seed: int = 0,
    cameras: tuple[str, ...] = (),
    width_px: int = 0,
    sh_degree: int = 0,
    semantics: bool = True,
    raster: Literal['auto', 'cpu', 'torch', 'gsplat'] = 'auto',
    device: str = 'auto',
    checkpoint_every: int = 500,
    preview_every: int = 500,
    start: Mapping[str, Any] = ...,
    densify: Mapping[str, Any] = ...,
    objects: Mapping[str, Any] = ...,
    poses: Mapping[str, Any] = ...,
    appearance: Mapping[str, Any] = ...,
    drawing: Mapping[str, Any] = ...,
    loss: Mapping[str, Any] = ...,
    virtual: Mapping[str, Any] = ...,
    radiance: Mapping[str, Any] = ...,
) -> Any:
    """Fit a dynamic 3D Gaussian scene to recorded (and virtual) views.

    Args:
        scene: Scene directory written by ingest or annotate, or folder of mudg run.
        fused: Point clouds written by fuse; required by every method but emernerf.
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        tensorboard: Also write the numbers of log.jsonl to OUT/tensorboard, for TensorBoard (needs `pip install 'mudg[track]'`).
        observations: Virtual views written by synthesize, in one folder or several; required by method mudg_s.
        start_from: Finished fit of method street_gaussians to the same scene, to continue for `iterations` more steps. Virtual views are used from the first of them on.
        config: YAML file of settings, read before those given here.
        method: What is fitted. gs3d: static Gaussians only. street_gaussians: static world, dynamic objects and sky. mudg_s: the same, supervised by virtual views. pvg, s3gaussian, emernerf (without boxes), omnire, bezier, difix (which learns from repaired renders): published methods for comparison (docs/baselines.md).
        iterations: Optimisation steps, each with one recorded view (mudg_s: sometimes a virtual view too). Learning rates and schedules adapt to this number. With `--start-from`: further steps, the second half of a schedule of twice as many.
        seed: Seed of all random numbers; the same seed gives the same result.
        cameras: Cameras whose recorded images are fitted (empty = all).
        width_px: Image width in pixels while fitting; the height follows (0 = as recorded). Lower it to save time and memory.
        sh_degree: Degree of the spherical harmonics for view-dependent colour. On short drives every degree above 0 overfits to the recorded path.
        semantics: Learn semantic classes where the scene has labels.
        raster: Rasteriser backend. auto picks the fastest one available and prints its name.
        device: Device: auto (CUDA if there is one), cpu, cuda, cuda:N.
        checkpoint_every: Steps between checkpoints; an interrupted fit resumes at the last one. Large ones are rarer: they take at most a twentieth of the time.
        preview_every: Steps between preview images.
        start:
        densify:
        objects:
        poses:
        appearance:
        drawing:
        loss:
        virtual:
        radiance:
    """
    ...

def fuse(
    scene: str | Path,
    *,
    out: str | Path,
    overwrite: bool = False,
    config: str | Path | None = None,
    voxel_m: float = 0.0,
    occlusion_test: bool = True,
    match_colors: bool = True,
    box_growth_m: float = 0.1,
    floor_margin_m: float = 0.1,
    moving_distance_m: float = 0.5,
    min_object_points: int = 100,
) -> Any:
    """Fuse LiDAR and images: a static coloured point cloud, one more per dynamic object.

    Args:
        scene: Scene directory written by ingest or annotate, or folder of mudg run.
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        config: YAML file of settings, read before those given here.
        voxel_m: Keep one point per voxel of this size, in metres (0 = keep all).
        occlusion_test: Do not colour points that lie behind a nearer surface.
        match_colors: Find how exposure and white balance differ between cameras, from points that several of them saw, and correct it in clouds, fits and generated views. A camera's own views keep its colours.
        box_growth_m: Boxes of dynamic objects are enlarged by this distance on each side, in metres. Raise it if objects leave points behind.
        floor_margin_m: Points up to this height, in metres, above the bottom of a dynamic object's box stay with the road.
        moving_distance_m: A tracked box is dynamic if its displacement or its path is longer than this, in metres.
        min_object_points: Dynamic objects with fewer coloured points than this are left out.
    """
    ...

def import_asset(
    file: str | Path,
    *,
    out: str | Path,
    overwrite: bool = False,
    config: str | Path | None = None,
    kind: Literal['object', 'scene'] = 'object',
    label: str = 'object',
    length_m: float | None = None,
    yaw_deg: float = 0.0,
    origin_m: tuple[float, float, float] | None = None,
    axes: str = 'file',
) -> Any:
    """Make an object, or a scene, of a file of Gaussians from another program.

    Args:
        file: File of Gaussians (.ply, .spz, .splat, .sog, .glb).
        out: File to write; with --kind scene, folder to write.
        overwrite: Replace the output if it exists.
        config: YAML file of settings, read before those given here.
        kind: object: an asset file. scene: the folder of a fit in which nothing moves.
        label: Class of the object, e.g. car or pedestrian.
        length_m: Scale the object so that its box has this length (not given: the file is in metres).
        yaw_deg: Turn what the file holds by this angle about the vertical, counter-clockwise from above, so that an object looks, or a street leads, along x.
        origin_m: With --kind scene: the place in the file that becomes the origin, after --axes and before --yaw-deg (not given: the file's own origin, or the middle of Gaussians that lie more than 16 km away).
        axes: Where x, y and z of the file point. file: as the file says, else as viewer. viewer: as programs expect of its format. world: x forward, y left, z up, as of export --axes world. Or three letters of L, R, U, D, F, B: RDF is x right, y down, z forward.
    """
    ...

def ingest(
    log: str,
    *,
    out: str | Path,
    overwrite: bool = False,
    config: str | Path | None = None,
    resolution: str = '',
    workers: int = 0,
    contact_sheet: bool = True,
    test_every: int = 4,
    format: str = 'auto',
    frames: str = '',
    cameras: tuple[str, ...] = (),
    sequence: str = '',
    poses: str = '',
    boxes: str = '',
    skip_missing: bool = False,
    untwist: Literal['auto', 'yes', 'no'] = 'auto',
    city: Mapping[str, Any] = ...,
) -> Any:
    """Convert a driving log, or the built-in city, to a scene directory.

    Args:
        log: LOG: folder of a dataset log, a scene directory, or the word city. FORMAT: its format, only needed if it is not recognised. OUT: the folder to write, in place of --out.
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        config: YAML file of settings, read before those given here.
        resolution: Image size of the scene: the longest side in pixels, e.g. 960, or WIDTHxHEIGHT (empty = as recorded). Images are never enlarged.
        workers: Threads that convert frames (0 = one per processor). The result does not depend on it.
        contact_sheet: Write contact_sheet.jpg: frames with LiDAR points and boxes, and the scene from above. Check it after every import.
        test_every: Hold out every n-th frame of all cameras for scoring (0 = none).
        format: Format of the log: kitti, kitti360, waymo, nuscenes, argoverse2, pandaset, nuplan, ncore or custom (auto = recognise it).
        frames: Frames to import, FIRST:END without END itself, e.g. 0:40 (empty = all). kitti, kitti360, pandaset: the numbers of their files; other formats: counted from 0.
        cameras: Cameras to import, by their names in the scene or in the dataset (empty = the format's default cameras).
        sequence: Log, sequence, scene or frame to import, if the folder holds several.
        poses: File (or folder of GPS/IMU packets) with vehicle poses (empty = search in the log).
        boxes: File with tracked boxes (empty = search in the log).
        skip_missing: Skip frames with a missing image, scan or vehicle pose instead of refusing the log.
        untwist: Compensate LiDAR scans for the vehicle's motion during a sweep (auto = if the dataset's scans need it).
        city:
    """
    ...

def learn(
    *,
    out: str | Path,
    overwrite: bool = False,
    tensorboard: bool = False,
    config: str | Path | None = None,
    seed: int = 0,
    start: str = '',
    steps: int = 2800,
    frozen: Literal['nothing', 'temporal_transformers', 'temporal_layers', 'denoiser'] = 'nothing',
    precision: Literal['auto', 'float32', 'bfloat16'] = 'auto',
    threads: int = 1,
    data: Mapping[str, Any] = ...,
    network: Mapping[str, Any] = ...,
    codec: Mapping[str, Any] = ...,
    optimizer: Mapping[str, Any] = ...,
    loss: Mapping[str, Any] = ...,
    score: Mapping[str, Any] = ...,
    compute: Mapping[str, Any] = ...,
) -> Any:
    """Train a diffusion model on generated cities, or fine-tune one on your own logs.

    Args:
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        tensorboard: Also write the numbers of log.jsonl to OUT/tensorboard, for TensorBoard (needs `pip install 'mudg[track]'`).
        config: YAML file of settings, read before those given here.
        seed: Seed of the cities, the initial weights and all other random numbers.
        start: Model to continue from: a folder written by learn or convert, or "embedded" for the shipped model (empty = train from scratch).
        steps: Training steps of the network.
        frozen: Layers that keep their weights. temporal_transformers: as in the published second stage. temporal_layers: all layers that mix frames. denoiser: train the refiner only.
        precision: Number format of the computation. auto: bfloat16 on CUDA devices and CPUs that compute in it, float32 elsewhere.
        threads: Threads of the training process. Results are repeatable for the same number of threads.
        data:
        network:
        codec:
        optimizer:
        loss:
        score:
        compute:
    """
    ...

def page(
    source: str | Path,
    *,
    out: str | Path,
    scene: str | Path | None = None,
    compare: str | Path | None = None,
    overwrite: bool = False,
    config: str | Path | None = None,
    method: str = '',
    budget: int = 3000000,
    images: int = 150,
) -> Any:
    """Write a fitted scene as one HTML page: fly through it, any layer, any time, without a network.

    Args:
        source: Folder of a finished mudg run, or Gaussian scene written by fit.
        out: Page to write: one file. Above 32 MB, a folder FILE_page beside it, for a web server.
        scene: Scene directory that a Gaussian scene was fitted to. A run has its own.
        compare: A second run or fit of the same log, to compare with. The same run: its two fits.
        overwrite: Replace the page if it exists.
        config: YAML file of settings, read before those given here.
        method: Fit of a run to show (empty = the best one: mudg_s, else street_gaussians).
        budget: Most Gaussians on the page (0 = all). Where a fit has more, those that the recorded cameras would see smallest and faintest are left out.
        images: Most recorded images on the page, taken evenly.
    """
    ...

def render(
    scene: str | Path,
    model: str | Path | None = None,
    *,
    out: str | Path,
    overwrite: bool = False,
    edits: str | Path | None = None,
    fused: str | Path | None = None,
    path: str | Path | None = None,
    config: str | Path | None = None,
    cameras: tuple[str, ...] = ('front',),
    shifts_m: tuple[float, ...] = (0.0, 2.0, -2.0, 3.0, -3.0, 4.0, -4.0),
    paths: tuple[str, ...] = (),
    width_px: int = 0,
    fov_deg: float = 0.0,
    lidar: str = '',
    layers: tuple[Literal['instances', 'normals', 'motion', 'distance', 'confidence'], ...] = (),
    video: bool = True,
    repair: bool = False,
    repair_model: str = 'embedded',
    raster: Literal['auto', 'cpu', 'torch', 'gsplat'] = 'auto',
    device: str = 'auto',
) -> Any:
    """Render RGB, depth and semantics of a fitted scene on shifted trajectories.

    Args:
        scene: Scene directory that the Gaussian scene was fitted to, or folder of mudg run.
        model: Gaussian scene written by fit, or edit (not given: that of the run at SCENE).
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        edits: Edit script (docs/edit.md) to carry out before rendering.
        fused: Point clouds written by fuse, for --repair (not given: those of the run at SCENE).
        path: Camera path to draw in place of the shifts: poses in the format of TUM or KITTI (.txt), or nerfstudio's transforms.json, on the scene's clock and in its world. It has the optics of the first camera.
        config: YAML file of settings, read before those given here.
        cameras: Cameras to render (empty = the first camera). A name that the scene lacks is an error.
        shifts_m: Lateral shifts in metres, positive to the left of the direction of travel; 0 = the recorded path.
        paths: Further paths by name. up+1: raised by 1 m. lane+0.1: a lane change, 0.1 m further to the left with every frame. speed+0.1: 0.1 m further ahead with every frame. A minus means down, right, slower.
        width_px: Image width in pixels (0 = as recorded); the height follows.
        fov_deg: Horizontal field of view in degrees (0 = the camera's own).
        lidar: Also simulate the log's LiDAR sweeps at every shift: a sensor of the scene, pandar128, at128, hdl64, vlp16, or a JSON file of beams (docs/simulator.md). Empty = none.
        layers: Also write these layers of every view, with its boxes and its trust: ids of objects, normals of surfaces, optical flow to the next view in pixels, distance along the ray in metres, and how certain a pixel is (docs/datasets.md).
        video: Also write one MP4 video per trajectory.
        repair: Let the diffusion model make every view once more from its render, and mix both by its confidence and by the distance from the recorded path. Better off the path, slower: half a second a view (docs/edit/repair.md).
        repair_model: Diffusion model of --repair: "embedded" or "embedded-tiny", both shipped with the package, or a folder written by learn.
        raster: Rasteriser backend. auto picks the fastest one available and prints its name.
        device: Device: auto (CUDA if there is one), cpu, cuda, cuda:N.
    """
    ...

def report(
    runs: tuple[str | Path, ...],
    *,
    out: str | Path,
    overwrite: bool = False,
) -> Any:
    """Write one page over many finished runs: pictures, links, and a table of all scores to sort and filter.

    Args:
        runs: Folders of mudg run, score, bench or batch; of any other folder, the folders in it.
        out: Page to write.
        overwrite: Replace the page if it exists.
    """
    ...

def run(
    source: str,
    *,
    out: str | Path,
    overwrite: bool = False,
    preset: Literal['fast', 'default', 'quality', 'paper'] | None = None,
    fast: bool = False,
    seed: int | None = None,
    cameras: tuple[str, ...] = (),
    shifts_m: tuple[float, ...] = (),
    config: str | Path | None = None,
    device: str = 'auto',
    guided_share: float = 1.5,
    ingest: Mapping[str, Any] = ...,
    annotate: Mapping[str, Any] = ...,
    fuse: Mapping[str, Any] = ...,
    synthesize: Mapping[str, Any] = ...,
    fit: Mapping[str, Any] = ...,
    render: Mapping[str, Any] = ...,
    score: Mapping[str, Any] = ...,
) -> Any:
    """Run all steps on your own driving log or scene and write a report page.

    Args:
        source: Folder of a dataset log (its format is recognised), a scene directory, or the word city.
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        preset: Settings to start from. fast: smaller images, fewer frames and iterations. default: minutes on two cores. quality: 30,000 iterations, millions of Gaussians, for a GPU. paper: the published set-up, with a published-type model (docs/presets.md).
        fast: The same as --preset fast: images of a log 480 pixels wide, 3 m to each side. One to two minutes on 2 cores for the city, or 16 frames of one camera.
        seed: Seed of all random numbers in all steps (not given: city 3 and seed 0, or the values in --config).
        cameras: Cameras for which shifted trajectories are made (not given: the first camera).
        shifts_m: Lateral shifts in metres, positive to the left (not given: 2, 3 and 4 m to both sides; --fast: 3 m). They apply to synthesize, render and score.
        config: YAML file of settings, read before those given here.
        device: Device of all steps: auto (CUDA if there is one), cpu, cuda, cuda:N. A step whose own device is set, as by --fit.device, keeps that one.
        guided_share: Iterations of the fit with virtual views, as a multiple of those of the fit without. Both begin from nothing.
        ingest:
        annotate:
        fuse:
        synthesize:
        fit:
        render:
        score:
    """
    ...

def score(
    scene: str | Path,
    views: Mapping[str, str | Path],
    *,
    out: str | Path,
    overwrite: bool = False,
    fused: str | Path | None = None,
    config: str | Path | None = None,
    width_px: int = 0,
    baseline: bool = True,
    perceptual_views: int = 8,
    lpips_weights: str = '',
    lpips_vgg_weights: str = '',
    lpips_input: Literal['correct', 'unscaled'] = 'correct',
    fid_weights: str = '',
    fid_resize: Literal['pytorch-fid', 'tf1', 'clean', 'tm', 'neurad'] = 'pytorch-fid',
    fvd_weights: str = '',
    fvd_resize: Literal['videogpt', 'google', 'stylegan-v'] = 'videogpt',
    detections: str = '',
    lanes: str = '',
    error_pictures: bool = True,
    device: str = 'auto',
) -> Any:
    """Compare views with ground truth: metrics, tables, error images.

    Args:
        scene: Scene directory that the views belong to, or folder of mudg run.
        views: Methods to compare: a name and the folder that render or synthesize wrote, e.g. mudg_s=runs/render.
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        fused: Point clouds written by fuse. They are needed for the baseline without learning (not given: no baseline).
        config: YAML file of settings, read before those given here.
        width_px: Image width in pixels at which everything is compared; the height follows (0 = the size of the scene's camera).
        baseline: Also score a baseline without learning: the fused points, with every hole filled by the nearest point.
        perceptual_views: Number of views per trajectory, evenly spread, at which the perceptual distance is computed (0 = none). It costs more than all other metrics together.
        lpips_weights: Safetensors file with LPIPS weights (AlexNet, version 0.1, tensor names of the lpips package). LPIPS is computed at the same views as the perceptual distance (empty = not computed).
        lpips_vgg_weights: The same for LPIPS with VGG-16 (empty = not computed).
        lpips_input: Range of the colours that LPIPS gets. unscaled: 0 to 1 where -1 to 1 belongs, as much published code of Gaussian scenes has it; only to compare with its numbers.
        fid_weights: File with the weights of FID's Inception-v3 network (`pt_inception-2015-12-05-6726825d.pth`, or its tensors as safetensors). FID and KID then compare all views with the recorded frames of the same camera (empty = not computed).
        fid_resize: How FID's network gets its 299 x 299 pixels: as pytorch-fid, torch-fidelity (tf1), clean-fid (clean), torchmetrics (tm) or neurad-studio (neurad) do it. Numbers of different rules cannot be compared.
        fvd_weights: File with the weights of FVD's I3D network (Kinetics-400), as safetensors, a state dict or the TorchScript archive. FVD then compares clips of 16 views with those of the recorded video of the same camera (empty = not computed).
        fvd_resize: How FVD's network gets its 224 x 224 pixels: shorter side and crop (videogpt), or squashed (google, stylegan-v).
        detections: File with boxes that a detector found in the views, as COCO results. NTA-IoU is then computed (empty = not computed).
        lanes: Folder with lane masks that a detector made of the views, METHOD/TRAJECTORY/000000.png. NTL-IoU is then computed (empty = not computed). Generated cities only: prepared logs have no lane lines.
        error_pictures: Write an image of the colour error at the middle view of every trajectory.
        device: Device of the networks behind perceptual distance, LPIPS, FID and FVD: auto (CUDA if there is one), cpu, cuda, cuda:N. All other metrics run on the CPU.
    """
    ...

def synthesize(
    scene: str | Path,
    fused: str | Path | None = None,
    *,
    out: str | Path,
    overwrite: bool = False,
    fitted: str | Path | None = None,
    edits: str | Path | None = None,
    config: str | Path | None = None,
    cameras: tuple[str, ...] = ('front',),
    shifts_m: tuple[float, ...] = (2.0, -2.0, 3.0, -3.0, 4.0, -4.0),
    paths: tuple[str, ...] = (),
    model: str = 'embedded',
    steps: int = 2,
    eta: float | None = None,
    condition: Literal['full', 'reference', 'points', 'concat', 'repair'] = 'full',
    given_classes: bool = True,
    align_depth: bool = True,
    overlap: int = 2,
    width_px: int = 0,
    full_size: bool = True,
    precision: Literal['auto', 'float32', 'bfloat16', 'float16'] = 'auto',
    device: str = 'auto',
    processes: int = 0,
    guidance: float | None = None,
    guidance_rescale: float | None = None,
    memory_budget_gb: float = 0.0,
    seed: int = 0,
) -> Any:
    """Generate dense RGB, depth and semantics on laterally shifted trajectories.

    Args:
        scene: Scene directory written by ingest or annotate, or folder of mudg run.
        fused: Point clouds written by fuse (not given: those of the run at SCENE).
        out: Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and reused.
        overwrite: Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is finished, so the disk must hold both. Files that do not belong to the old result are kept.
        fitted: Gaussian scene written by fit, without virtual views. Its renders become part of the diffusion model's input. For models that were trained with renders.
        edits: Edit script (docs/edit.md): make views of the drive as it says.
        config: YAML file of settings, read before those given here.
        cameras: Cameras for which shifted views are made (empty = the first camera). A name that the scene lacks is an error.
        shifts_m: Lateral shifts in metres, positive to the left of the direction of travel; 0 = the recorded path.
        paths: Further paths by name: up+1, lane+0.1, speed-0.1, ..., as for render.
        model: Diffusion model: "embedded" or "embedded-tiny", both shipped with the package, or a model folder written by learn or convert.
        steps: Denoising steps. More add texture and agree less with the truth pixel by pixel. Use 50 for published-type models.
        eta: Noise added between steps, from 0 (deterministic) to 1 (as much as the reverse process has) (not given: 1).
        condition: Which parts of the model's condition are given, to measure what each brings. reference: the nearest recorded image alone. points: LiDAR points alone. concat: both, without images warped by depth (published-type models: the image in frame 0, not in the image tokens). The shipped models were trained on whole conditions. repair: renders of `--fitted` and the nearest recorded image, without points; gives colour alone.
        given_classes: Use the classes of labelled points and recorded images in the model's condition, if the scene has labels.
        align_depth: Align generated depth to the LiDAR points in the same view (one scale and one shift per frame).
        overlap: Frames that a window of the model shares with the previous window; they are kept, so that the video continues smoothly. Published-type models: 8.
        width_px: Image width in pixels at which the model works (0 = about the area it was trained at, in the camera's aspect ratio).
        full_size: Write views at the camera's size: by the model's finisher, or, where it has none, with detail restored from warped recorded images. Off: at the size the model works at.
        precision: Number format of the diffusion model. auto: bfloat16 on CUDA devices and CPUs that compute in it, float32 elsewhere (published-type models on older CUDA devices: float16). float16: published-type models on CUDA devices, as in the release.
        device: Device of the diffusion model: auto (CUDA if there is one), cpu, cuda, cuda:N, mps.
        processes: Number of trajectories made at the same time, with one thread each (0 = one per core; one for published-type models, and where the diffusion model is not on the CPU).
        guidance: Published-type models: scale of classifier-free guidance; 1 = none, which halves the work (not given: 7.5).
        guidance_rescale: Published-type models: guidance rescale, 0 (off) to 1; limits overexposure by guidance (not given: 0.7).
        memory_budget_gb: Published-type models: memory in GB; the work is split to fit into it (0 = what is free on a CUDA device; elsewhere do not split). The result stays the same.
        seed: Seed of the noise.
    """
    ...
