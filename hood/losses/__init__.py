"""One energy per file and the potential that sums them."""
