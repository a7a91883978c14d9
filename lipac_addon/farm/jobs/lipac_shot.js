// SPDX-License-Identifier: GPL-3.0-or-later

// A shot culled by LiPaC, as a job type of Flamenco 3: copy this file into the folder "scripts" beside flamenco-manager.
// The steps are those of `lipac farm`; workers need the command lipac, those that only render need a Blender alone.

const JOB_TYPE = {
    label: "LiPaC Shot",
    description: "Analyze a shot by light paths, render it with what it needs, and verify a sample of its frames",
    settings: [
        { key: "frames", type: "string", required: true,
          eval: "f'{C.scene.frame_start}-{C.scene.frame_end}'",
          evalInfo: { showLinkButton: true, description: "Scene frame range" },
          description: "Frames of the shot, without gaps. Examples: '47', '1-30'" },
        { key: "chunk_size", type: "int32", default: 10, propargs: { min: 1 }, visible: "submission",
          description: "Frames to a task" },
        { key: "max_error", type: "float", default: 0.01, propargs: { min: 0.0, max: 1.0 }, visible: "submission",
          label: "Error Budget", description: "How much the picture may change, as a share; a single tile of it five times as much" },
        { key: "verify", type: "int32", default: 0, propargs: { min: 0 }, visible: "submission",
          description: "Frames to render in full as well, in parts; 0: one in 25, at least 2" },
        { key: "shot_folder", type: "string", subtype: "dir_path", required: true,
          eval: "str(Path(abspath('//')) / 'lipac' / jobname)",
          description: "Folder for pictures and all else of the shot, which all workers see" },
        { key: "lipac", type: "string", default: "lipac", visible: "submission", label: "LiPaC",
          description: "The lipac command of the workers; a variable of the manager's, such as {lipac}, may stand for it" },
        { key: "options", type: "string", default: "", visible: "submission",
          description: "More options of lipac farm, such as --samples 64" },
        { key: "blendfile", type: "string", required: true, description: "Path of the Blend file", visible: "web" },
    ],
};

const FRAMES_TO_A_CHECK = 25;

function compileJob(job) {
    const settings = job.settings;
    const frames = frameRange(settings.frames);
    const count = frames.last - frames.first + 1;
    const checks = Math.min(count, settings.verify || Math.max(2, Math.ceil(count / FRAMES_TO_A_CHECK)));
    const chunks = chunked(frames, settings.chunk_size);
    const own = ["--scene", settings.blendfile, "--quiet"];

    const prepare = step(settings, "prepare", [
        "farm", settings.blendfile, "-o", settings.shot_folder, "--for", "flamenco", "--no-measure", "--frames", `${frames.first}-${frames.last}`,
        "--max-error", `${settings.max_error}`, "--verify", `${checks}`, "--chunk", `${settings.chunk_size}`, "--quiet",
    ].concat(settings.options ? shellSplit(settings.options) : []));
    const analyze = chunks.map((chunk) => shotStep(settings, `analyze-${chunk}`, "analyze", ["--frames", chunk].concat(own)));
    const unite = shotStep(settings, "unite", "unite", own);
    const judge = chunks.map((chunk) => shotStep(settings, `judge-${chunk}`, "judge", ["--frames", chunk].concat(own)));
    const render = chunks.map((chunk) => renderTask(settings, chunk));
    const verify = [];
    for (let number = 1; number <= checks; number++) {
        verify.push(shotStep(settings, `verify-${number}`, "verify", ["--check", `${number}`, "--blender", "{blender}"].concat(own)));
    }
    const certify = shotStep(settings, "certify", "certify", ["--quiet"]);
    addInOrder(job, [[prepare], analyze, [unite], judge.concat(render), verify, [certify]]);
}

// First and last of 'A-B' or 'A'.
function frameRange(text) {
    const found = /^\s*(\d+)\s*(?:(?:-|\.\.)\s*(\d+)\s*)?$/.exec(`${text}`);
    const first = found ? Number(found[1]) : 1;
    const last = found ? Number(found[2] || found[1]) : 0;
    if (first > last) {
        throw `'${text}' is no range of frames without gaps: give A-B, for example 1-24`;
    }
    return { first: first, last: last };
}

// Ranges of at most so many frames, as 'A-B' or 'A'. The manager's frameChunker writes two frames as 'A,B', and knows gaps.
function chunked(frames, size) {
    const chunks = [];
    for (let first = frames.first; first <= frames.last; first += size) {
        const last = Math.min(first + size - 1, frames.last);
        chunks.push(first == last ? `${first}` : `${first}-${last}`);
    }
    return chunks;
}

// A task that runs the lipac command.
function step(settings, name, args) {
    const words = shellSplit(settings.lipac || "lipac");
    const task = author.Task(name, "blender");
    task.addCommand(author.Command("exec", { exe: words[0], args: words.slice(1).concat(args) }));
    return task;
}

function shotStep(settings, name, what, args) {
    return step(settings, name, ["shot", what, settings.shot_folder].concat(args));
}

// A task that renders frames by a Blender that need not have LiPaC.
function renderTask(settings, chunk) {
    const ends = chunk.split("-").map(Number);
    const task = author.Task(`render-${chunk}`, "blender");
    task.addCommand(author.Command("blender-render", {
        exe: "{blender}",
        exeArgs: "{blenderArgs}",
        argsBefore: [],
        blendfile: path.join(settings.shot_folder, "shot.blend"),
        args: ["--python-exit-code", "1", "--python", path.join(settings.shot_folder, "render", "render_frames.py"), "--", settings.shot_folder, "--frames", chunk],
    }, ends[ends.length - 1] - ends[0] + 1));
    return task;
}

// Each task of a stage waits for all of the stage before.
function addInOrder(job, stages) {
    for (let k = 0; k < stages.length; k++) {
        for (const task of stages[k]) {
            for (const before of k ? stages[k - 1] : []) {
                task.addDependency(before);
            }
            job.addTask(task);
        }
    }
}
