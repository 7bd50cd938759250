"""``cnpgen view``: robots, plans and samples as a page that any browser opens.

The page contains MeshCat's viewer but does not use Pinocchio's ``MeshcatVisualizer``, which writes a page by a server
on all network interfaces. Its pages also have no curves of the limits and show no robot without link geometry.
"""
