"""Work beside the user's: jobs with a thread, the analysis, live mode, the measured difference.

bpy is touched on the main thread only; a job can be cancelled at any step and leaves the file as it was.
"""
