"""What all studies share: from a plan of trainings to models, a report and tables; see `driver.main`."""
