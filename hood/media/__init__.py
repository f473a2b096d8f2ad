"""Pictures and films of simulated clothing, drawn in software: no display and no graphics card needed."""
