"""OTED (Gur, Nachum and Faust 2021), as far as it is known: its abstract, and appendix D.2 of Jiang et al. 2024."""
