"""All texts of the application in English; another language is a file of the same fields in ``assets``.

`TEXTS` are those of the language that was chosen last in this process: read them where they are shown, not at import.
"""

from __future__ import annotations

import locale
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, cast

from pydantic import TypeAdapter

from rtof_kin.core.files.text import load_toml

_CATALOGUES: Final = Path(__file__).parent / "assets"  #: A file for each other language


@dataclass(frozen=True)
class Texts:
    """The catalogue. Names in braces are filled in."""

    title: str = "rtof-kin"
    code: str = "en-US"  # as HTML and Quasar name the language
    language: str = "English"  # in itself
    levels: tuple[str, ...] = ("person", "visit", "recording")
    states: tuple[tuple[str, str], ...] = (
        ("draft", "draft"),
        ("waiting", "waiting"),
        ("running", "running"),
        ("done", "done"),
        ("needs attention", "needs attention"),
        ("failed", "failed"),
        ("has a question", "has a question"),
    )
    # store
    bad_name: str = "{name}: use 1 to 64 letters, digits, - and _, and begin with a letter or digit"
    bad_file_name: str = "{name}: a file of this name is not taken; rename it to letters, digits, - and _"
    is_link: str = "{name}: is a link; the workspace has folders only"
    not_there: str = "There is no {kind} {name}"
    exists: str = "{name}: is there already; choose another name"
    file_exists: str = "{name}: is there already; remove it first"
    not_written: str = "This cannot be written ({error}); free some space, or choose another workspace"
    not_in_trash: str = "This is no longer in the trash"
    no_height: str = "Give the height in centimetres, between 40 and 260: every length follows it"
    no_day: str = "{day!r} is no day; write it as 2026-01-31"
    nothing_recorded: str = "Add a video, a detector's keypoints, or files of sensors"
    # people and visits
    people: str = "People"
    no_people: str = "Nobody is here yet. Add the first person by an identifier, not by a name."
    identifier: str = "Identifier (no name)"
    height: str = "Standing height in cm"
    add_person: str = "Add person"
    date: str = "Date of the visit, as 2026-01-31"
    add_visit: str = "Add visit"
    recording: str = "Name of the recording, as walk"
    add_recording: str = "Add recording"
    of_height: str = "{height:.0f} cm tall"
    # trash
    delete: str = "Move {name} to the trash"
    deleted: str = "{name} is in the trash"
    at_work: str = "Something is being made of this; wait, or cancel it first"
    trash: str = "Trash"
    empty_trash: str = "The trash is empty."
    restore: str = "Take {name} back"
    # a result that is looked at and mended
    review: str = "Video, motion and curves"
    to_review: str = "Look at it beside the video, and mend it"
    to_recording: str = "Files and report of this recording"
    no_result: str = "There is no result yet: reconstruct the recording first"
    mend: str = "Correct by hand"
    correction: str = "What is corrected"
    from_s: str = "From, s"
    to_s: str = "To, s"
    who_mends: str = "Who (initials)"
    why: str = "Why"
    add_correction: str = "Add"
    take_back: str = "Take back: {what}"
    unsolved: str = "What was corrected is not in the result yet."
    solve_again: str = "Solve again"
    incomplete: str = "Say what is corrected, who you are, and why"
    no_range: str = "Choose a range below: 'range starts here' and 'range ends here'"
    leave_out_sensor: str = "Leave out the sensor {name}"
    corrections: tuple[tuple[str, str], ...] = (
        ("leave_out all", "Leave out everything"),
        ("leave_out image", "Leave out the picture"),
        ("leave_out sensors", "Leave out all sensors"),
        ("exchange_sides", "Exchange left and right in the picture"),
        ("foot_contact left", "The left foot stands"),
        ("foot_contact right", "The right foot stands"),
        ("stride left", "This is a stride of the left foot"),
        ("stride right", "This is a stride of the right foot"),
        ("foot_strike left", "The left foot strikes at the start"),
        ("foot_strike right", "The right foot strikes at the start"),
        ("foot_off left", "The left foot lifts off at the start"),
        ("foot_off right", "The right foot lifts off at the start"),
        ("no_event left", "No step of the left foot here"),
        ("no_event right", "No step of the right foot here"),
        ("repetition squat", "This is one squat"),
        ("repetition sit_to_stand", "This is one rise from a seat"),
    )
    # notes, archives, downloads and what is made
    notes: str = "Notes on {name}"
    counted: str = "{state}: {count}"
    export: str = "Export as one archive"
    with_videos: str = "with videos; links and hidden files are never in it"
    left_out: str = "Left out: {names}"
    take_archive: str = "Drop the archive of a person here, or press +"
    no_archive: str = "This is no archive of a person, or it is damaged"
    large_archive: str = "This archive would become {size:.1f} GB: too much for its size, or for the disk"
    bad_member: str = "This archive is not taken: {name} in it could do harm, or is there twice"
    making: str = "{name} is being made"
    being_made: str = "This is being made; the page may be closed meanwhile"
    delete_made: str = "Delete {name} for good; it can be made again"
    downloads: str = "In other formats, made when you ask for them:"
    long_for_xlsx: str = "This recording is too long for a workbook; take the CSV"
    no_browser: str = (
        "No Chrome, Chromium or Edge is found here; open the report in a new tab and print it there as PDF"
    )
    not_printed: str = "The browser did not print the report; open it in a new tab and print it there as PDF"
    # comparisons and plans
    compare: str = "Compare"
    nothing_to_compare: str = "No recording has a result yet"
    baseline: str = "First visit"
    compare_visits: str = "Compare all visits"
    recording_a: str = "Recording"
    recording_b: str = "Compared with"
    sides: str = "itself: left and right"
    plan: str = "Plan a session"
    movement: str = "What is to be recorded"
    as_in: str = "as in {name}"
    sensors: str = "Sensors at hand"
    plan_search: str = "Compare places of the camera and further sensors: some minutes instead of half a minute"
    make_plan: str = "Make the plan"
    pages: tuple[tuple[str, str], ...] = (
        ("follow.html", "Visits compared, in a new tab"),
        ("comparison.html", "Comparison, in a new tab"),
        ("plan.html", "What to expect, in a new tab"),
        ("instructions.html", "Page for the operator, to print"),
    )
    # a recording
    files: str = "1. Files"
    not_taken: str = "The file did not arrive; is the disk full?"
    all_files: str = "Add or remove files"
    drop: str = "Drop video, keypoints and sensor files here, or a folder as .zip, or press +"
    remove: str = "Remove {name}"
    sources: tuple[tuple[str, str], ...] = (  # as `SourceKind` has them
        ("a video", "a video"),
        ("a detector's keypoints", "a detector's keypoints"),
        ("files of sensors", "files of sensors"),
        ("a camera calibration", "a camera calibration"),
        ("a map of sensors", "a map of sensors"),
        ("a log of the phone that filmed", "a log of the phone that filmed"),
        ("a recording folder", "a recording folder"),
        ("unknown", "not recognised"),
    )
    ready: str = "Ready: {parts}."
    width_px: str = "Width of the image in px"
    height_px: str = "Height of the image in px"
    rate: str = "Frames per second, if not in the keypoints"
    who: str = "Who was seen"
    size_needed: str = "Keypoints do not say how large the image is: give it, or add the video"
    reconstruct_title: str = "2. Reconstruction"
    reconstruct: str = "Reconstruct"
    again: str = "Reconstruct again"
    cancel: str = "Cancel"
    waiting: str = "{count} before this one"
    starting: str = "starting"
    left: str = "about {time} left"
    finishing: str = "angles and report"
    lost: str = "The reconstruction ended without an answer ({how}); is there too little memory?"
    findings: str = "What was found"
    result: str = "3. Result"
    no_file: str = "There is no such file yet"
    report: str = "Open the report in a new tab"
    # record live
    record: str = "Record live"
    camera: str = "Camera: number, device or video file; empty: none"
    search: str = "Look again"
    searching: str = "Looking for cameras and sensors"
    cameras_found: str = "Cameras here: {names}"
    no_cameras: str = "No camera was found: connect one and look again, or write its number"
    no_streams: str = "No sensors were found: start the program that sends them over LSL, and look again"
    keep_video: str = "Keep the video"
    points_kept: str = "Kept: points of the body and what the sensors send, on this machine alone. No picture is kept."
    video_kept: str = "Kept: the video and what the sensors send, on this machine alone."
    countdown: str = "Countdown in s"
    start: str = "Start"
    stop: str = "Stop"
    preparing: str = "{name}: getting ready"
    counting: str = "{name} begins in {time} s"
    recording_now: str = "{name}: recording, {time} s"
    saving: str = "{name}: saving"
    figure: str = "Live figure"
    recorded: str = "{name} is recorded; go on there"
    records_already: str = "Another recording is being made; stop it first"
    record_lost: str = "The recording ended without an answer; what came is kept, and shown after a restart"
    no_source: str = "Choose a camera or sensors"
    no_such_camera: str = "{camera}: is neither a camera nor a file; give one that was found"
    no_models: str = "The models that find people in pictures are not on this machine; fetch them in First steps"
    kinds: tuple[tuple[str, str], ...] = (
        ("given", "given"),
        ("file", "from the files"),
        ("found", "found"),
        ("assumed", "assumed"),
        ("doubtful", "in doubt"),
    )
    stages: tuple[tuple[str, str], ...] = (  # as `run` reports them
        ("detect", "finding the person in the video"),
        ("camera", "where the camera is"),
        ("lift", "from image to space"),
        ("sensors", "where the sensors are"),
        ("calibrate", "calibration from the motion"),
        ("rto", "solving the motion by the image"),
        ("rtof", "solving the motion by image and sensors"),
        ("imu", "solving the motion by the sensors"),
        ("certificate", "checking by left-out sensors"),
    )
    # first steps
    to_start: str = "First steps, language and a check of this computer"
    first_steps: str = "First steps"
    language_of: str = "Language"
    tour: str = "Five steps from a person to a report"
    steps: tuple[tuple[str, str], ...] = (
        ("1. Person and visit", "Add a person by an identifier and the height, then a visit."),
        ("2. Record", "One camera that stands still; the whole body in view. Sensors on limbs make it better."),
        ("3. Drop the files", "The video and the sensors' files. What is missing is said."),
        ("4. Reconstruct", "Press the button. It takes some minutes, and goes on when the window is closed."),
        (
            "5. Read the report",
            "Joint angles with bands: within them the true angle is expected. Read what is in doubt.",
        ),
    )
    put_away: str = "Understood, do not show this again"
    demo_title: str = "Try it without a camera"
    demo_about: str = (
        "A person “demo” with 24 s of exercises that come with the application: image points and eight "
        "simulated sensors of a real movement (CMU motion capture, mocap.cs.cmu.edu). Then press Reconstruct."
    )
    demo: str = "Try the demo"
    check: str = "Check of this computer"
    checking: str = "looking ..."
    good: str = "good"
    missing: str = "missing"
    at_hand: str = "It is at hand."
    not_installed: str = "It is not installed."
    not_fetched: str = "It is not on this computer."
    no_answer: str = "There was no answer."
    nothing: str = "None was found."
    gigabytes: str = "{size:.0f} GB are free."
    detector: str = "Finding people in a video: {title}"
    fetch_todo: str = "Only videos need it; keypoints and sensors do not."
    terms: str = (
        "{title}: {size} MB from {places}. Licence: {licence}. Nothing is sent but the request for these files."
    )
    fetch: str = "Agree and fetch {size} MB"
    fetching: str = "{done} of {total} MB"
    pdf: str = "A browser for PDF files"
    pdf_todo: str = "Install Chromium, Chrome or Edge; or print the report to a PDF from the browser that you have."
    disk: str = "Space on the disk of the workspace"
    disk_todo: str = "Free some space, or choose another workspace."
    memory: str = "Memory"
    memory_todo: str = "Close other programs during a reconstruction."
    cameras: str = "Cameras"
    cameras_todo: str = (
        "Connect a camera, close other programs that use it, and allow it in the settings of the system."
    )
    streams: str = "Streams of sensors (LSL)"
    streams_todo: str = "Start the program that sends them, in the same network. Only live recordings need them."
    devices: str = "Look for cameras and sensors"
    devices_about: str = (
        "This switches each camera on for a moment, and asks the local network for streams of sensors. "
        "Nothing else is contacted."
    )
    # files of a recording
    without_image: str = "No video and no keypoints: the person stands still for some seconds at first."
    without_sensors: str = "No sensors: the motion comes from the image alone."
    without_camera: str = "No camera calibration: the camera is found from the motion."
    zip_large: str = "has more than 16 GB or 100,000 files unpacked; drop its files by themselves"
    zip_twice: str = "has two files of one name; drop its files by themselves"
    zip_damaged: str = "no archive that can be unpacked ({error}); pack it again, without a password"
    nothing_second: str = "Of the second camera a video or keypoints are needed"
    second: str = "{name} is of the second camera"
    synchronised: str = "Both cameras have one clock (started by one signal)"
    pose: str = "How the person stands at first"
    poses: tuple[tuple[str, str], ...] = (("N", "arms hanging"), ("T", "arms to the sides"), ("seated", "seated"))
    look: str = "Look at it first"
    looking: str = "looking at the recording"
    asked_person: str = "Several people are in the picture: choose the one that this recording is of."
    asked_sensors: str = "Which sensor is where is not sure: choose in the drawing of the body."
    learn: str = "Learn from this recording: bones and posture of the person are kept for later ones"
    learned: str = "Learned: {what}"
    change_height: str = "Change the height"
    who_second: str = "Who was seen by the second camera"
    who_hint: str = "Click on the person, or choose the number."
    person: str = "Person {number}"
    nobody: str = "Found by itself: the most prominent person"
    body: str = "Where the sensors are"
    body_hint: str = "Drag a sensor to its place, or press it and then the place, or choose from its list."
    body_map: str = "The map of sensors among the files says it; remove it to choose here."
    body_sides: str = "right | left, as the person says"
    sure: str = "{percent:.0f} % by its motion"
    stated: str = "as stated"
    unsure: str = "not known"
    no_place: str = "left out"
    use_places: str = "Use these places"
    drop_places: str = "Take the places back"
    same_place: str = "Two sensors are at one place; give each a place of its own"
    no_places: str = "Give at least one sensor its place"
    bad_sensor: str = "The name of a sensor cannot be written in a map: {name}"
    segments: str = (
        "Head head, Spine3 chest, Spine lower back, Hips pelvis, LeftShoulder left shoulder blade, "
        "LeftArm left upper arm, LeftForeArm left forearm, LeftHand left hand, LeftUpLeg left thigh, "
        "LeftLeg left shank, LeftFoot left foot, RightShoulder right shoulder blade, RightArm right upper arm, "
        "RightForeArm right forearm, RightHand right hand, RightUpLeg right thigh, RightLeg right shank, "
        "RightFoot right foot"
    )
    """Segments that carry sensors, each with its name."""
    options: tuple[tuple[str, str], ...] = (
        (r"^(compare|follow|plan): | \(--by\)", ""),
        (r"(add|give)( e\.g\.)? --height( [\d.]+( \(m\))?)?", "give it on the person's page"),
        (r"--height ", "height "),
        (r"choose( one with)? --person", "choose --person"),
        (r"; --person takes another one", "; a click on the picture takes another one"),
        (r"--person ", "person "),
        (r"--size \S+", "width and height of the image in the fields above"),
        (r"by --rate 60 \(Hz\)", "in the field above"),
        (r", --map FILE", ", or choose their places in the drawing of the body"),
        (r"; --pose takes another one", "; choose another one above"),
        (r"(?s)no detector of people is at hand.*", "No models that find people are here: fetch them in First steps"),
        (r"add --fetch-models (\S+):", r"fetch the models \1 once:"),
        (r" \(--fetch-models rtmpose, --model-dir DIR\)", ""),
        (r": --model-dir DIR", " in the folder of models"),
        (r"`rtof-kin inspect` looks at each sensor", "Look at the file of each sensor"),
        (r"; (rtof-kin inspect lists their gaps|--update-subject makes it, or write it \(docs/subject\.md\))", ""),
        (r"; go on with: rtof-kin reconstruct \S+", "; drop the files that it was made from"),
        (r"; name another folder by -o, or add --overwrite(, which replaces that person's results)?", ""),
        (
            r".*: cannot be written \((\[Errno \d+\] )?(.+?)\); (name another file|choose another folder)",
            r"\2; free some space",
        ),
    )
    """What the engine says of options of the command line, as patterns, and how a page calls them."""

    @property
    def places(self) -> dict[str, str]:
        """Names of the segments that carry sensors."""
        return {segment: words for segment, _, words in (one.partition(" ") for one in self.segments.split(", "))}


class _Chosen:
    def __init__(self) -> None:
        self.texts = Texts()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.texts, name)


_chosen: Final = _Chosen()
TEXTS: Final = cast(Texts, _chosen)


@cache
def languages() -> dict[str, Texts]:
    """Return the catalogues by their codes."""
    files = sorted(_CATALOGUES.glob("*.toml"))
    others = (TypeAdapter(Texts).validate_python(load_toml(path)) for path in files)
    return {texts.code: texts for texts in (Texts(), *others)}


def speak(code: str = "") -> None:
    """Choose the language of this process; by default that of the machine, else English."""
    known = languages()
    local = (locale.getlocale()[0] or "").lower()  # German_Germany on Windows
    _chosen.texts = known.get(code) or known["de" if local.startswith(("de_", "german")) else "en-US"]


def worded(sentence: str) -> str:
    """Return a sentence of the engine in the words of a page: without options of the command line."""
    for pattern, words in TEXTS.options:
        sentence = re.sub(pattern, words, sentence)
    return sentence
