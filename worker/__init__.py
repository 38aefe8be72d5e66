"""Jobs: their state, the queue, the artefacts and the tasks that render them."""
