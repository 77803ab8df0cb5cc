"""OTED (Gur, Nachum and Faust 2021), after its abstract and appendix D.2 of Jiang et al. 2024."""
