"""From solver files to the dataset: survey, structure, alignment, transfer, staging, assembly."""
