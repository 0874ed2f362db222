"""A radiance field of a street that is marched along rays (EmerNeRF): static, dynamic and flow fields on hash grids."""
