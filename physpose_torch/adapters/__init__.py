"""Other people's estimators: their collections, files and arrays in, the same out with refined poses.

Nothing here imports another project; what counts is the attributes that its objects have.

- :mod:`.happypose`: ``PandasTensorCollection`` (happypose, MegaPose, CosyPose), as a depth refiner or a function.
- :mod:`.datasets`: ``RigidObjectDataset`` or a folder of meshes to bodies.
- :mod:`.megapose`: ``object_data.json`` and ``camera_data.json`` of MegaPose's example folders.
- :mod:`.foundationpose`: one 4×4 array an object.
- :mod:`.surroundings`: what stands around the objects of each image, for all of these.
"""
