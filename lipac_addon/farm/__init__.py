"""A shot on a farm: its steps on a shared folder, the graph that they make, and the jobs that describe it to those who
run it.

    analyze (chunks of frames) -> unite -> render (chunks, plain Blender) -> verify (a sample of frames) -> certify

What a step leaves, in the shot's folder (`layout`):

    job.json                    what is asked; its `key` stands in all that is made from it, so that nothing made
    otherwise counts render/render_frames.py     renders frames in any Blender, without this add-on
    analysis/frame_0001.npz     what a frame needs by itself                                  analyze
    analysis/frames_0001-0010.npz   what frames of a chunk need together, so that few files are united  analyze
    shot.blend, shot.json       the scene with one set for all frames; which set that is      unite
    pictures/frame_0001.png     and .json: seconds, memory, from which set                    render
    verified/frame_0007.json    what culling changes in a frame of the sample, and what was done about it   verify
    mended/0005-0008_1.blend    the scene with a larger set, for frames around one that failed              verify
    certificate.json, .html     what was found                                                certify

Files are put in place whole, by renaming; no step waits for a lock, and none writes what another reads at the same
time. So a step may be killed, repeated, split otherwise, or done by two machines at once: the pictures are the same.
"""
