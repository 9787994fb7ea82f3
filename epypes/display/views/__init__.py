"""What is to be seen of a graph, a runner, a run, a plan or a pipeline, whoever paints it?"""
