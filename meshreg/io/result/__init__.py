"""What a run writes: the record, the evidence, the folder and its manifest."""
