"""Where the parts meet: the command, the pipeline, results, scores and figures."""
