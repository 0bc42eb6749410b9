"""Benchmarks: what one main job costs in time, memory and bytes, beside the same work written with Open3D and OpenCV.

Run from the checkout's root by `python -m benchmarks.main_job`. Nothing of the program imports from here.
"""
