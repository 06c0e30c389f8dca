"""Bad calls of geometry, bodies, materials, fields, bases and amplitudes; see `operation_calls`."""

CASES = [
    ('pm.Grid.box(("a","b"),(1,1),0.5)', "bad", ("lower",)),
    ("pm.Grid.box(None,(1,1),0.5)", "bad", ("lower",)),
    ('pm.Grid.box((0,0),(1,1),"x")', "bad", ("cell",)),
    ("pm.Grid.box((0,0),(1,1),None)", "bad", ("cell",)),
    ("pm.Grid.box((0,0),(1,1),1j)", "bad", ("cell",)),
    ("pm.Grid.box((0,0),(1,1),(0.5,))", "bad", ("cell",)),
    ("pm.Grid.box((0,0),(1,1),-0.5)", "bad", ("cell",)),
    ('pm.Grid.box((0,0),(1,1),float("nan"))', "bad", ("cell",)),
    ('pm.Grid.box((0,0),(float("inf"),1),0.5)', "bad", ("upper", "lower")),
    ("pm.Grid.box((0,),(1,),0.5)", "bad", ("lower", "coordinates")),
    ("pm.Grid.box((0,0,0,0),(1,1,1,1),0.5)", "bad", ("lower", "coordinates")),
    ("pm.Grid.box([[0,0]],[[1,1]],0.5)", "bad", ("lower",)),
    ("pm.Grid.box((0,0),(1,1),1e-300)", "bad", ("cell", "lattice")),
    ("pm.Grid.box((0,0),(1,1),0.3)", "bad", ("cell",)),
    (
        "pm.Grid.box((0,0),(1,1),0.5,comm=None)\npm.seed(pm.Grid.box((0,0),(1,1),0.5,comm=None),material=MP)",
        "bad",
        ("comm",),
    ),
    ('pm.Grid.box((0,0),(1,1),0.5,comm="world")', "bad", ("comm",)),
    ("g=pm.Grid((0.0,0.0),(0.0,1.0),(3,3))\npm.seed(g,material=MP)", "bad", ("cell",)),
    ("g=pm.Grid((0.0,0.0),(1.0,1.0),(-3,3))\npm.seed(g,material=MP)", "bad", ("shape",)),
    ("pm.Grid.box((0,0),(1e9,1e9),1.0)", "ok", ()),
    ("pm.Grid.box((1e16,0),(1e16+4,1),1.0)", "either", ()),
    ("pm.seed(None,material=MP)", "bad", ("grid",)),
    ("pm.seed(grid(),inside)", "bad", ("material",)),
    ('pm.seed(grid(),inside,material="steel")', "bad", ("material",)),
    ("pm.seed(grid(),inside,material=pm.MicropolarElastic)", "bad", ("material",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=0)", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=-2)", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=2.0)", "bad", ("points_per_cell",)),
    ('pm.seed(grid(),inside,material=MP,points_per_cell="2")', "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=None)", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=True)", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=(2,2,2))", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=100000)", "bad", ("points_per_cell", "memory")),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=10**20)", "bad", ("points_per_cell",)),
    ("pm.seed(pm.Grid.box((0,0),(1e9,1e9),1.0),material=MP)", "bad", ("bounds", "grid", "points")),
    ('pm.seed(grid(),inside,material=MP,layout="random")', "bad", ("layout",)),
    ("pm.seed(grid(),inside,material=MP,layout=[1])", "bad", ("layout",)),
    ("pm.seed(grid(),inside,material=MP,bounds=5)", "bad", ("bounds",)),
    ("pm.seed(grid(),inside,material=MP,bounds=((0,0),))", "bad", ("bounds",)),
    ('pm.seed(grid(),inside,material=MP,bounds=((0,0),("a",1)))', "bad", ("bounds",)),
    ('pm.seed(grid(),inside,material=MP,bounds=((0,0),(float("nan"),1)))', "bad", ("bounds",)),
    ("pm.seed(grid(),inside,material=MP,bounds=((1,1),(0,0)))", "bad", ("bounds",)),
    ("pm.seed(grid(),lambda x: x[:,0],material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: True,material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: None,material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: x[:,2]>0,material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda: 1,material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: x[:,0]>99,material=MP)", "bad", ("inside",)),
    ('pm.seed(grid(),"box",material=MP)', "bad", ("inside",)),
    ("pm.seed_mesh(grid(),None,material=MP)", "bad", ("mesh",)),
    ('pm.seed_mesh(grid(),"/nonexistent.msh",material=MP)', "bad", ("mesh",)),
    ("pm.seed_mesh(grid(),mesh2(),material=MP,degree=0)", "either", ("degree",)),
    ("pm.seed_mesh(grid(),mesh2(),material=MP,degree=-1)", "bad", ("degree",)),
    ('pm.seed_mesh(grid(),mesh2(),material=MP,degree="2")', "bad", ("degree",)),
    ("pm.seed_mesh(grid(),mesh2(),material=MP,degree=500)", "bad", ("degree",)),
    ("pm.seed_mesh(grid(),mesh2(),material=MP,degree=2.5)", "bad", ("degree",)),
    (
        'open(OUT+"/g.msh","w").write("garbage")\npm.seed_mesh(grid(),OUT+"/g.msh",material=MP)',
        "bad",
        ("mesh",),
    ),
    (
        'open(OUT+"/g.geo","w").write("garbage(")\npm.seed_mesh(grid(),OUT+"/g.geo",material=MP)',
        "bad",
        ("mesh",),
    ),
    ('open(OUT+"/e.msh","wb").write(b"")\npm.seed_mesh(grid(),OUT+"/e.msh",material=MP)', "bad", ("mesh",)),
    ("pm.Points(np.zeros((3,2)),np.ones(3),np.ones((3,2)),None,grid().comm)", "bad", ("material",)),
    ("pm.Points(np.zeros((3,2)),np.ones(2),np.ones((3,2)),MP,grid().comm)", "bad", ("volume",)),
    (
        "p=pm.Points(np.zeros((3,2)),-np.ones(3),np.ones((3,2)),MP,grid().comm)\n"
        'pm.QuasiStatic(grid(),p,basis="mpm")',
        "bad",
        ("volume",),
    ),
    (
        "p=pm.Points(np.zeros((3,2)),np.ones(3)*np.nan,np.ones((3,2)),MP,grid().comm)\n"
        'pm.QuasiStatic(grid(),p,basis="mpm")',
        "bad",
        ("volume",),
    ),
    (
        "p=pm.Points(np.full((3,2),np.nan),np.ones(3),np.ones((3,2)),MP,grid().comm)\n"
        'pm.QuasiStatic(grid(),p,basis="mpm")',
        "bad",
        ("outside", "x"),
    ),
    (
        "p=pm.Points(np.zeros((3,2)),np.ones(3),-np.ones((3,2)),MP,grid().comm)\n"
        'q=pm.QuasiStatic(grid(),p,basis="gimpm")\n'
        "q.fix(lambda x: x[:,0]<0,u=0,theta=0)\n"
        "q.attempt(1.0)",
        "bad",
        ("half_length",),
    ),
    (
        "p=pm.Points(np.zeros((3,2)),np.ones(3),np.full((3,2),9.0),MP,grid().comm)\n"
        'q=pm.QuasiStatic(grid(),p,basis="gimpm")\n'
        "q.fix(lambda x: x[:,0]<0,u=0,theta=0)\n"
        "q.attempt(1.0)",
        "bad",
        ("half_length", "domain"),
    ),
    ("p=pm.Points(np.zeros((3,4)),np.ones(3),np.ones((3,4)),MP,grid().comm)", "bad", ("x", "dimension")),
    (
        "p=pm.Points(np.zeros((0,2)),np.ones(0),np.ones((0,2)),MP,grid().comm)\n"
        'q=pm.QuasiStatic(grid(),p,basis="mpm")\n'
        "run(q)",
        "bad",
        ("point",),
    ),
    ("p=pm.Points([[0,0]],[1.0],[[1,1]],MP,grid().comm)", "ok", ()),
    ("pts().where(lambda x: 1)", "bad", ("predicate",)),
    ("pts().where(None)", "bad", ("predicate",)),
    ("pts().where(lambda x: x[:,0]/0)", "bad", ("predicate",)),
    ("pts().farthest(None)", "bad", ("direction",)),
    ('pts().farthest("x")', "bad", ("direction",)),
    ("pts().farthest((0,0))", "bad", ("direction",)),
    ("pts().farthest((1,0,0))", "bad", ("direction",)),
    ('len(pts().farthest((float("inf"),0)))', "bad", ("direction",)),
    ("len(pts().farthest((1,0),tolerance=-1.0))", "bad", ("tolerance",)),
    ('len(pts().farthest((1,0),tolerance=float("nan")))', "bad", ("tolerance",)),
    ('len(pts().farthest((1,0),tolerance="a"))', "bad", ("tolerance",)),
    ("len(pts().nearest((0,0),count=0))", "bad", ("count",)),
    ("len(pts().nearest((0,0),count=-1))", "bad", ("count",)),
    ("len(pts().nearest((0,0),count=1.5))", "bad", ("count",)),
    ("len(pts().nearest((0,0),count=10**9))", "either", ("count",)),
    ('pts().nearest((float("nan"),0)).ids', "bad", ("position",)),
    ('pts().nearest("ab")', "bad", ("position",)),
    ("pts().rows([1,2])", "bad", ("selection",)),
    ("p=pts()\np.mean(np.ones(3))", "bad", ("values",)),
    ("p=pts()\np.mean(np.ones(3), p.nearest((0,0)))", "bad", ("values",)),
    ('p=pts()\np.mean_displacement("tip")', "bad", ("selection",)),
    ("p=pts()\np.join(p)\nlen(p)", "bad", ("other", "itself")),
    ("pts().join(None)", "bad", ("other",)),
    ('pts().join("x")', "bad", ("other",)),
    (
        "p=pts()\n"
        "p.join(pts())\n"
        'q=pm.QuasiStatic(grid(),p,basis="mpm")\n'
        '"same body joined twice: mass doubled"',
        "either",
        (),
    ),
    ("p=pts()\np.assign(p.nearest((0,0)),None)", "bad", ("material",)),
    ("p=pts()\np.assign([0,1],VM)", "bad", ("selection",)),
    ("p=pts()\np.assign(p.nearest((0,0)),NH)", "bad", ("material",)),
    ("p=pts()\np.assign(pm.Selection(np.array([10**6])),VM)", "bad", ("selection",)),
    ("p=pts()\ns=pm.Selection(np.array([5,3,1]))\nlen(p.rows(s))==3 or 1/0", "either", ()),
    (
        "q=clamped()\n"
        "s=pm.Selection(np.array([5,3,9,1]))\n"
        "q.load(s,force=(0,10.0))\n"
        "run(q)\n"
        "f=q.reaction(q.supports[0])[0]\n"
        "assert abs(f[1]+10)>1e-6\n"
        "f",
        "bad",
        ("selection",),
    ),
    (
        "q=clamped()\n"
        "q.load(pm.Selection(np.array([3,3,3])),force=(0,10.0))\n"
        "run(q)\n"
        "f=q.reaction(q.supports[0])[0]\n"
        "assert abs(f[1]+10)>1e-6\n"
        "f",
        "bad",
        ("selection",),
    ),
    (
        "q=clamped()\n"
        "q.load(pm.Selection(np.array([10**9])),force=(0,10.0))\n"
        "run(q)\n"
        "q.reaction(q.supports[0])[0]",
        "bad",
        ("selection",),
    ),
    (
        "q=clamped()\nq.load(pm.Selection([1,2]),force=(0,10.0))\nrun(q)\nq.reaction(q.supports[0])[0]",
        "ok",
        (),
    ),
    (
        "q=clamped()\n"
        "q.load(pm.Selection(np.array([1.5,2.5])),force=(0,10.0))\n"
        "run(q)\n"
        "q.reaction(q.supports[0])[0]",
        "bad",
        ("selection",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["lam"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("lam",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["mu"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("mu",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["kappa"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("kappa",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["alpha"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("alpha",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["beta"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("beta",),
    ),
    (
        'd=dict(lam=1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)\nd["gamma"]="1"\npm.MicropolarElastic(**d)',
        "bad",
        ("gamma",),
    ),
    ("pm.MicropolarElastic(lam=True,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)", "either", ("lam",)),
    ("pm.MicropolarElastic(lam=1.,mu=1.,kappa=1j,alpha=0.,beta=1.,gamma=1.)", "bad", ("kappa",)),
    ("pm.MicropolarElastic(lam=1.,mu=1.,kappa=None,alpha=0.,beta=1.,gamma=1.)", "bad", ("kappa",)),
    ("pm.MicropolarElastic(lam=np.ones(3),mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)", "bad", ("lam",)),
    ("pm.MicropolarElastic()", "bad", ("lam",)),
    ("pm.MicropolarElastic.from_engineering(E=1e6,nu=0.5,n=0,l_b=0,l_t=0,psi=1)", "bad", ("nu",)),
    ("pm.MicropolarElastic.from_engineering(E=1e6,nu=0.3,n=1,l_b=0,l_t=0,psi=1)", "bad", ("n =",)),
    ("pm.MicropolarElastic.from_engineering(E=1e6,nu=0.3,n=0.1,l_b=1,l_t=3,psi=1)", "bad", ("l_t",)),
    ("pm.MicropolarElastic.from_engineering(E=1e6,nu=0.3,n=0.1,l_b=1,l_t=1,psi=0)", "bad", ("psi",)),
    (
        "pm.MicropolarElastic.from_engineering(E=1e306,nu=0.3,n=0.1,l_b=1e10,l_t=1,psi=1)",
        "bad",
        ("is not a finite", "out of range"),
    ),
    ('pm.MicropolarElastic.bounded_stiffness(lam=1,mu=1,kappa="a",l_b=1)', "bad", ("kappa",)),
    (
        "q=loaded(2,pm.MicropolarElastic(lam=1e300,mu=1e300,kappa=1e300,alpha=0.,beta=1.,gamma=1.))\n"
        "run(q)\n"
        "show(q)",
        "either",
        ("modul", "stiff", "finite"),
    ),
    (
        "q=loaded(2,pm.MicropolarElastic(lam=1e-300,mu=1e-300,kappa=0,alpha=0.,beta=0.,gamma=0.),f="
        "1e-302)\n"
        "run(q)\n"
        "show(q)",
        "either",
        ("singular", "diverged", "tried"),
    ),
    ("pm.NeoHookean(lam=-1,mu=1)", "bad", ("lam",)),
    ('pm.NeoHookean("a","b")', "bad", ("lam",)),
    ('pm.Hencky(lam=1,mu=float("nan"))', "bad", ("mu",)),
    ("pm.UserEnergy(None)", "bad", ("function",)),
    ("pm.UserEnergy(lambda E,G,p: 1.0, values=5)", "bad", ("values",)),
    ("pm.UserEnergy(lambda E,G,p: p.a, values={1: 2.0})", "bad", ("values",)),
    ('pm.UserEnergy(lambda E,G,p: p.a, values={"a b": 2.0})', "either", ("values",)),
    ('pm.UserEnergy(lambda E,G,p: p.a, values={"a": "x"})', "bad", ("a =",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: p.b*ufl.tr(E), {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: E, {"a":1.0}))', "bad", ("scalar",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: None, {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: "text", {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: 1/0, {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G: ufl.tr(E), {"a":1.0}))', "bad", ("function",)),
    (
        'q=loaded(2,pm.UserEnergy(lambda E,G,p: 0.0, {"a":1.0}))\nrun(q)\nshow(q)',
        "bad",
        ("singular", "energy", "stiff", "diverged", "tried"),
    ),
    (
        'q=loaded(2,pm.UserEnergy(lambda E,G,p: p.a*ufl.tr(E), {"a":1.0}))\nrun(q)\nshow(q)',
        "bad",
        ("singular", "diverged", "tried"),
    ),
    (
        'q=loaded(2,pm.UserEnergy(lambda E,G,p: p.a*ufl.sqrt(ufl.inner(E,E))+p.a*ufl.inner(G,G), {"'
        'a":1e6}))\n'
        "run(q)\n"
        "show(q)",
        "bad",
        ("not finite", "nan", "diverged"),
    ),
    (
        'q=loaded(2,pm.UserEnergy(lambda E,G,p: -p.a*ufl.inner(E,E)-p.a*ufl.inner(G,G), {"a":1e6}))\n'
        "run(q)\n"
        "show(q)",
        "either",
        ("singular", "diverged", "tried"),
    ),
    (
        "q=loaded(2,pm.UserEnergy(lambda E,G,p: p.a*ufl.inner(E,E)+p.a*ufl.inner(G,G)+ufl.bessel_J("
        '0,E[0,0]), {"a":1e6}))\n'
        "run(q)",
        "bad",
        ("bessel",),
    ),
    (
        "import random\n"
        "q=loaded(2,pm.UserEnergy(lambda E,G,p: p.a*random.random()*ufl.inner(E,E)+p.a*ufl.inner(G,"
        'G), {"a":1e6}))\n'
        "run(q)\n"
        "show(q)",
        "either",
        (),
    ),
    (
        "prob(2,pm.UserEnergy(lambda E,G,p: p.a*E[0,0]**2+100*p.a*E[1,1]**2+p.a*ufl.inner(E,E)+p.a*"
        'ufl.inner(G,G),{"a":1e6},isotropic=True))',
        "bad",
        ("isotropic",),
    ),
    ("DruckerPrager(None,phi=0.5,c=1e3,l_p=0.1)", "bad", ("elastic", "material")),
    ("DruckerPrager(VM,phi=0.5,c=1e3,l_p=0.1)", "bad", ("elastic",)),
    ("DruckerPrager(MP,phi=30,c=1e3,l_p=0.1)", "bad", ("phi",)),
    ("DruckerPrager(MP,phi=0.5,psi=0.6,c=1e3,l_p=0.1)", "bad", ("psi",)),
    ("DruckerPrager(MP,phi=0.5,l_p=0.1)", "bad", ("c =",)),
    ("DruckerPrager(MP,phi=0.5,c=1,k=1,l_p=0.1)", "bad", ("c =",)),
    ('DruckerPrager(MP,phi=0.5,c="1",l_p=0.1)', "bad", ("c =",)),
    ("DruckerPrager(MP,phi=0.5,c=1)", "bad", ("l_p",)),
    ("DruckerPrager(NH,phi=0.5,c=1,l_p=1)", "bad", ("l_p",)),
    ("VonMises(MP,k=0,l_p=0.1)", "bad", ("k =",)),
    ("VonMises(MP,k=-1,l_p=0.1)", "bad", ("k =",)),
    ("VonMises(MP,l_p=0.1)", "bad", ("k =",)),
    ('VonMises(MP,k=1,l_p=float("inf"))', "bad", ("l_p",)),
    ("UserPlasticity(MP,None)", "bad", ("function",)),
    ('prob(2,UserPlasticity(MP,lambda t,n,c,p: t,{"y":1.0}))', "bad", ("yield", "scalar")),
    ('prob(2,UserPlasticity(MP,lambda t,n,c,p: p.zz,{"y":1.0}))', "bad", ("yield", "zz")),
    ('UserPlasticity(MP,lambda t,n,c,p: p.y,{"mu":1.0})', "bad", ("mu",)),
    (
        'q=loaded(2,UserPlasticity(MP,lambda t,n,c,p: ufl.inner(t,t)+1.0,{"y":1.0}))\nrun(q)',
        "bad",
        ("yield", "return", "stress", "tried"),
    ),
    ("class M(pm.Material): pass\nprob(2,M())", "bad", ("energy",)),
    (
        "class M(pm.Material):\n"
        "    def energy(self,E,G,p): return ufl.inner(E,E)\n"
        '    def parameters(self): return {"a": float("nan")}\n'
        "q=loaded(2,M())\n"
        "run(q)\n"
        "show(q)",
        "either",
        ("a", "finite"),
    ),
    (
        "class M(pm.Material):\n"
        "    def energy(self,E,G,p): return p.a*ufl.inner(E,E)+p.a*ufl.inner(G,G)\n"
        '    def parameters(self): return {"a": float("nan")}\n'
        "q=loaded(2,M())\n"
        "run(q)\n"
        "show(q)",
        "bad",
        ("a", "finite", "nan"),
    ),
    ("pm.plane()", "bad", ("x, y, z",)),
    ("pm.plane(x=1,y=1)", "bad", ("x, y, z",)),
    ("pm.plane(w=1)", "bad", ("x, y, z",)),
    ('pm.plane(x="a")', "bad", ("x",)),
    ("pm.plane(x=None)", "bad", ("x",)),
    ('prob().fix(pm.plane(x=float("nan")),u=0)', "bad", ("x",)),
    ('prob().fix(pm.plane(x=float("inf")),u=0)', "bad", ("x",)),
    ('prob(basis="bspline").fix(pm.plane(x=float("nan")),u=0)', "bad", ("x",)),
    ('fem().fix(pm.plane(x=float("nan")),u=0)', "bad", ("x",)),
    ('pm.plane(x=0.0,beyond="left")', "bad", ("beyond",)),
    ("pm.plane(x=0.0,beyond=None)", "bad", ("beyond",)),
    ('pm.plane(x=0.0,moving="yes")', "bad", ("moving",)),
    ("prob().fix(pm.plane(x=0.5),u=0)", "bad", ("plane",)),
    ("prob().fix(pm.plane(x=100.0),u=0)", "bad", ("plane",)),
    ("prob().fix(pm.plane(z=0.0),u=0)", "bad", ("plane",)),
    ('prob(basis="bspline").fix(pm.plane(x=0.0),u=0)', "bad", ("bspline",)),
    (
        "q=loaded()\nrun(q)\nq.points.x[:]=np.nan\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("outside", "x", "nan", "finite"),
    ),
    (
        "q=loaded(reset=1)\nrun(q)\nq.points.F[:]=np.nan\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("F", "nan", "finite"),
    ),
    (
        "q=loaded(reset=1)\nrun(q)\nq.points.q[:]=0\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("q", "nan", "finite", "unit"),
    ),
    (
        "q=loaded(reset=1)\nrun(q)\nq.points.F[:]*=-1\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("F", "inside out", "det", "tried"),
    ),
    ("q=loaded()\nq.points.assign(q.points.nearest((1,0)),VM)\nrun(q)", "bad", ("material",)),
    (
        "M2=pm.MicropolarElastic.from_engineering(E=1e3,nu=0.3,n=0.3,l_b=0.1,l_t=0.1,psi=1.0)\n"
        "p=pts()\n"
        "p.assign(p.where(lambda x:x[:,0]>2),M2)\n"
        'q=pm.QuasiStatic(grid(),p,basis="mpm",reset=None)\n'
        "q.fix(lambda x:x[:,0]<1e-6,u=0,theta=0)\n"
        "q.load(p.farthest((1,0)),force=(0,1.0))\n"
        "run(q)\n"
        "u=p.mean_displacement()\n"
        "p.assign(p.where(lambda x:x[:,0]<1.5),M2)\n"
        "run(q,1,to=1.5)\n"
        "e=q.energies()\n"
        "u,p.mean_displacement(),e",
        "bad",
        ("material",),
    ),
    ("# join after problem\nq=loaded()\nq.points.join(pts())\nrun(q)\nshow(q)", "bad", ("points",)),
    (
        "# join after a step\nq=loaded(reset=None)\nrun(q)\nq.points.join(pts())\nrun(q,1,to=2.0)\nshow(q)",
        "bad",
        ("points",),
    ),
    ("pm.Surface(None,1,2)", "bad", ("Surface",)),
    ("pm.Surface([[0,0]],[1.0],[[1,1]])", "bad", ("normal",)),
    ("pm.Surface([[0,0]],[0.0],[[1,0]])", "bad", ("area",)),
    ("pm.Surface([[0,0]],[1.0,2],[[1,0]])", "bad", ("area",)),
    ('pm.Surface([[0,float("nan")]],[1.0],[[1,0]])', "bad", ("x",)),
    ("pm.Surface.line((0,0),(0,0),3)", "bad", ("line",)),
    ("pm.Surface.line((0,0),(1,0),0)", "bad", ("points",)),
    ("pm.Surface.line((0,0),(1,0),2.5)", "bad", ("points",)),
    ("pm.Surface.rectangle((0,0,0),(1,0,0),(2,0,0),3)", "bad", ("parallel",)),
    ("pm.Surface.rectangle((0,0,0),(0,0,0),(0,1,0),3)", "bad", ("edge",)),
    ("pm.Surface.rectangle((0,0,0),(1,0,0),(0,1,0),(1,2,3))", "bad", ("points",)),
    ("pm.Grid.box((0,0),(1,1),True)", "bad", ("cell",)),
    ("pm.Grid.box(np.array([0,0]),np.float32([1,1]),np.float32(0.5))", "ok", ()),
    ("pm.Grid.box((0,0),(1,1),10**400)", "bad", ("cell",)),
    ("pm.Grid.box((0,0),(1,1),[[0.5],[0.5,1]])", "bad", ("cell",)),
    ('pm.Grid.box("ab","cd",1)', "bad", ("lower",)),
    ("pm.Grid((0,0),(1,1),(2.5,2))", "bad", ("shape",)),
    ('pm.Grid((0,0),(1,1),"22")', "bad", ("shape",)),
    ("pm.Grid((0,0,0),(1,1),(2,2))", "bad", ("cell",)),
    ('pm.Grid((0,0),(float("nan"),1),(2,2))', "bad", ("cell",)),
    ("pm.Grid((0,0),(1,1),(10**10,10**10))", "bad", ("cell", "nodes")),
    ("import pickle\nassert pickle.loads(pickle.dumps(grid())) == grid()", "ok", ()),
    ("repr(grid())", "ok", ()),
    ("import copy\nassert copy.deepcopy(grid()) == grid()", "ok", ()),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=np.int32(2))", "ok", ()),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=np.array([2,3]))", "ok", ()),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=(2,))", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=(2,0))", "bad", ("points_per_cell",)),
    ("pm.seed(grid(),inside,material=MP,points_per_cell=[])", "bad", ("points_per_cell",)),
    ('pm.seed(grid(),inside,material=MP,points_per_cell=3000,layout="gauss")', "bad", ("points_per_cell",)),
    ("pm.seed(pm.Grid.box((0,0),(20000,20000),1.0),material=MP,points_per_cell=3)", "bad", ("GiB",)),
    ("pm.seed(pm.Grid.box((0,0,0),(1e5,1e5,1e5),1.0),inside,material=MP)", "bad", ("bounds",)),
    ('pm.seed(grid(),inside,material=MP,bounds="ab")', "bad", ("bounds",)),
    ("pm.seed(grid(),inside,material=MP,bounds=((0,0),(1e300,1)))", "bad", ("bounds",)),
    ("pm.seed(grid(),inside,material=MP,bounds=np.array([[0,0],[3,1]]))", "ok", ()),
    ("pm.seed(grid(),inside,material=MP,cut=None)", "bad", ("cut",)),
    ("pm.seed(grid(),lambda x: np.full(len(x),np.nan),material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: [True]*len(x),material=MP)", "ok", ()),
    ("pm.seed(grid(),lambda x: inside(x)[:-1],material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: inside(x)[:,None],material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: inside(x).astype(int),material=MP)", "bad", ("inside",)),
    ("pm.seed(grid(),lambda x: 1/0,material=MP)", "bad", ()),
    ("pm.seed(grid(),lambda x,y: inside(x),material=MP)", "bad", ("inside",)),
    (
        "pm.seed(grid(),lambda x: x.__isub__(0.5) is None or inside(x),material=MP,cut=False).x.min()",
        "ok",
        (),
    ),
    (
        "p=pts()\n"
        "x=p.x.copy()\n"
        "p.where(lambda x: x.__isub__(9.0) is None or x[:,0]>0)\n"
        "assert np.array_equal(p.x,x)",
        "ok",
        (),
    ),
    ("pm.Points(np.zeros((3,2)),np.ones((3,1)),np.ones((3,2)),MP,grid().comm)", "bad", ("volume",)),
    ("pm.Points(np.zeros((3,2)),np.ones(3),np.ones(3),MP,grid().comm)", "bad", ("half_length",)),
    (
        "pm.Points(np.zeros((3,2)),np.ones(3),np.ones((3,2)),MP,grid().comm,half_axes=np.ones((3,2)))",
        "bad",
        ("half_axes",),
    ),
    (
        "pm.Points(np.zeros((3,2)),np.ones(3),np.ones((3,2)),MP,grid().comm,half_axes=np.full((3,2,"
        "2),np.inf))",
        "bad",
        ("half_axes",),
    ),
    ("pm.Points(np.zeros((3,2)),np.ones(3),np.ones((3,2)),MP,None)", "bad", ("comm",)),
    ("pm.Points(np.zeros((3,2)),np.ones(3),np.ones((3,2)),MP,grid().comm,first_id=-1)", "bad", ("first_id",)),
    (
        "pm.Points(np.zeros((3,2)),np.ones(3),np.ones((3,2)),MP,grid().comm,first_id=1.5)",
        "bad",
        ("first_id",),
    ),
    ("pm.Points(np.zeros((3,2),dtype=complex),np.ones(3),np.ones((3,2)),MP,grid().comm)", "bad", ("x",)),
    ('pm.Points([["a","b"]],[1],[[1,1]],MP,grid().comm)', "bad", ("x",)),
    ("pm.Points(None,None,None,MP,grid().comm)", "bad", ("x",)),
    ("pts().where(lambda x: np.nonzero(x[:,0]>0)[0])", "bad", ("predicate",)),
    ("pts().where(lambda x,y: x[:,0]>0)", "bad", ("predicate",)),
    ("len(pts().where(lambda x: x[:,0]>99))", "ok", ()),
    ("p=pts()\ns=p.where(lambda x: x[:,0]>99)\np.mean_displacement(s)", "bad", ("selection",)),
    ("assert len(pts().farthest((1e300,1e300)))==1", "ok", ()),
    ("assert len(pts().farthest((1e-300,0)))==len(pts().farthest((1,0)))", "ok", ()),
    ("len(pts().nearest((1e200,0),count=3))", "ok", ()),
    ("pts().nearest((0,0),count=np.int64(2))", "ok", ()),
    ("pts().nearest((0,0),count=True)", "bad", ("count",)),
    ("pts().farthest((1,0),tolerance=np.float32(0.1))", "ok", ()),
    ("pm.Selection([3,-1])", "bad", ("ids",)),
    ("pm.Selection([-3,1])", "bad", ("ids",)),
    ('pm.Selection("abc")', "bad", ("ids",)),
    ("pm.Selection(None)", "bad", ("ids",)),
    ("pm.Selection([[1,2]])", "bad", ("ids",)),
    ("pm.Selection([[1],[1,2]])", "bad", ("ids",)),
    ("pm.Selection([True,False])", "bad", ("ids",)),
    ("pm.Selection([10**30])", "bad", ("ids",)),
    ('pm.Selection([1],body="me")', "bad", ("body",)),
    ('p=pts()\np.mean(p.hardening if p.plastic else ["a"]*len(p))', "bad", ("values",)),
    ("p=pts()\np.mean(p.x[:,0]>1)", "ok", ()),
    ("p=pts()\np.mean(None)", "bad", ("values",)),
    ("p=pts()\nq=pts(3)\np.mean_displacement(q.farthest((1,0,0)))", "bad", ("selection",)),
    (
        "import copy\n"
        "p=pts()\n"
        "q=copy.deepcopy(p)\n"
        "assert q is not p and np.array_equal(q.x,p.x) and q.x is not p.x\n"
        "q.mean_displacement(p.farthest((1,0)))",
        "ok",
        (),
    ),
    ("import pickle\np=pts()\nq=pickle.loads(pickle.dumps(p))\nassert np.array_equal(q.x,p.x)\nq", "ok", ()),
    ("import copy\np=pts()\nq=copy.copy(p)\nq.x[:]=0\nassert p.x.max()>0", "ok", ()),
    (
        "repr(pts(3)),repr(pts().farthest((1,0))),repr(VM),repr(NH),repr(pm.plane(x=1)),repr(pm.Sur"
        "face.line((0,0),(1,0),3))",
        "ok",
        (),
    ),
    ("pm.NeoHookean(lam=True,mu=1)", "bad", ("lam",)),
    ("pm.NeoHookean(lam=np.float32(1),mu=np.int64(2))", "ok", ()),
    ("pm.NeoHookean(lam=1,mu=10**400)", "bad", ("mu",)),
    ('pm.NeoHookean.from_engineering(E="1e6",nu=0.3)', "bad", ("E =",)),
    ("pm.Hencky.from_engineering(E=1e6,nu=np.array([0.3]))", "bad", ("nu",)),
    ("pm.NeoHookean.from_engineering(E=1e6,nu=0.5)", "bad", ("nu",)),
    ("pm.NeoHookean.from_engineering(E=1e6,nu=0.49999999999999994)", "either", ("nu",)),
    ("pm.MicropolarElastic(lam=-1.,mu=1.,kappa=1.,alpha=0.,beta=1.,gamma=1.)", "bad", ("3 lam + 2 mu",)),
    ("pm.MicropolarElastic(lam=1.,mu=1.,kappa=1.,alpha=-1.,beta=1.,gamma=1.)", "bad", ("3 alpha + 2 gamma",)),
    ("pm.MicropolarElastic.from_engineering(E=1e6,nu=0.3,n=0.3,l_b=1e200,l_t=0,psi=1.0)", "bad", ("l_b",)),
    (
        "pm.MicropolarElastic.from_engineering(E=1e6,nu=0.3,n=0.3,l_b=0.1,l_t=0.1,psi=1e-320)",
        "either",
        ("psi",),
    ),
    ("pm.UserEnergy(lambda *a: 0, values=None)", "bad", ("values",)),
    ('pm.UserEnergy(lambda E,G,p: 1, micropolar="yes")', "bad", ("micropolar",)),
    ("pm.UserEnergy(lambda E,G,p: 1, isotropic=1)", "bad", ("isotropic",)),
    ("pm.UserEnergy(lambda F,p: 1, micropolar=True)", "bad", ("function",)),
    ("pm.UserEnergy(lambda E,G,p: 1, micropolar=False)", "bad", ("function",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: np.exp(ufl.tr(E)), {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: [1.0], {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: np.ones(2), {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: 1j*ufl.tr(E), {"a":1.0}))', "either", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: p.a*3, {"a":1.0}))', "bad", ("energy", "depend")),
    ('prob(2,pm.UserEnergy(lambda E,G,p: float("nan")*ufl.tr(E), {"a":1.0}))', "bad", ("energy", "nan")),
    ('prob(2,pm.UserEnergy(lambda E,G,p: ufl.ln(ufl.tr(E)), {"a":1.0}))', "bad", ("rest",)),
    (
        'prob(2,pm.UserEnergy(lambda F,p: p.a*ufl.ln(-ufl.det(F)), {"a":1.0}, micropolar=False))',
        "bad",
        ("rest",),
    ),
    ('prob(2,pm.UserEnergy(lambda E,G,p: E.foo, {"a":1.0}))', "bad", ("foo",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: ufl.inner(E,p.a), {"a":1.0}))', "bad", ("energy",)),
    ('prob(2,pm.UserEnergy(lambda E,G,p: E[3,3]**2, {"a":1.0}))', "bad", ("energy",)),
    (
        "class M(pm.Material):\n"
        "    def energy(self,E,G,p): return ufl.inner(E,E)\n"
        '    def parameters(self): return {"a": "x"}\n'
        "prob(2,M())",
        "bad",
        ("a =",),
    ),
    (
        "class M(pm.Material):\n"
        "    def energy(self,E,G,p): return ufl.inner(E,E)\n"
        "    def parameters(self): return [1]\n"
        "prob(2,M())",
        "bad",
        ("parameters",),
    ),
    (
        "class M(pm.Material):\n"
        '    micropolar="yes"\n'
        "    def energy(self,E,G,p): return ufl.inner(E,E)\n"
        "prob(2,M())",
        "bad",
        ("micropolar",),
    ),
    (
        "class M(pm.Material):\n"
        "    micropolar=False\n"
        "    def measures(self,F): return F\n"
        "    def energy(self,F,p): return ufl.inner(F,F)\n"
        "prob(2,M())",
        "either",
        ("measures", "energy"),
    ),
    (
        "class M(pm.Material):\n"
        "    micropolar=False\n"
        "    def measures(self,F): return (1/0,)\n"
        "    def energy(self,F,p): return ufl.inner(F,F)\n"
        "prob(2,M())",
        "bad",
        ("measures",),
    ),
    ("DruckerPrager(MP,phi=0.5,c=1e3,l_p=True)", "bad", ("l_p",)),
    ("DruckerPrager(MP,phi=0.5,c=1e3,l_p=0.1,tip=-1)", "bad", ("tip",)),
    ('DruckerPrager(MP,phi=0.5,c=1e3,l_p=0.1,H="a")', "bad", ("H",)),
    ("DruckerPrager(MP,phi=np.float32(0.5),c=np.int64(1000),l_p=0.1)", "ok", ()),
    ("VonMises(MP,k=1e3,l_p=[0.1])", "bad", ("l_p",)),
    ("UserPlasticity(MP,lambda t,n,c: t)", "bad", ("function",)),
    ("UserPlasticity(MP,lambda t,n,c,p: t,values=[1])", "bad", ("values",)),
    ('UserPlasticity(MP,lambda t,n,c,p: t,values={"y":1.0},continuation=3)', "bad", ("continuation",)),
    (
        'UserPlasticity(MP,lambda t,n,c,p: t,values={"y":1.0},continuation=pm.Continuation("z",(1.0,)))',
        "bad",
        ("continuation",),
    ),
    ('UserPlasticity(MP,lambda t,n,c,p: t,values={"y":1.0},hardening=lambda c: c)', "bad", ("hardening",)),
    ('pm.Continuation("y","ab")', "bad", ("values",)),
    ('pm.Continuation("y",(1,float("nan")))', "bad", ("values",)),
    ("pm.Continuation(3,(1,))", "bad", ("parameter",)),
    ('pm.YieldSurface("",lambda t,n,c,p: t)', "bad", ("name",)),
    ('pm.YieldSurface("a",None)', "bad", ("function",)),
    ('pm.YieldSurface("a",lambda t: t)', "bad", ("function",)),
    ("pm.Edge()", "bad", ("surface",)),
    ('pm.Edge("a")', "bad", ("surface",)),
    ("pm.SmoothPart(None)", "bad", ("surface",)),
    ('pm.ConeApex(None,pm.YieldSurface("a",lambda t,n,c,p: t))', "bad", ("cone",)),
    ('pm.ConeApex(VM,"a")', "bad", ("surface",)),
    ("class P(pm.Plastic):\n    elastic=MP\n    regions=5\nprob(2,P())", "bad", ("regions",)),
    ("class P(pm.Plastic):\n    elastic=MP\n    regions=()\nprob(2,P())", "bad", ("yield surface",)),
    ('class P(pm.Plastic):\n    elastic=MP\n    regions=("a",)\nprob(2,P())', "bad", ("Region",)),
    ("class P(pm.Plastic):\n    elastic=MP\nprob(2,P())", "bad", ("yield",)),
    ('pm.Field("",lambda p: p.x)', "bad", ("name",)),
    ("pm.Field(None,lambda p: p.x)", "bad", ("name",)),
    ('pm.Field("J",None)', "bad", ("function",)),
    ('pm.Field("J",lambda: 1)', "bad", ("function",)),
    ('pm.Field("J",lambda p: p.x,unit=3)', "bad", ("unit",)),
    ('pm.Field("J",lambda p: p.x,plastic="no")', "bad", ("plastic",)),
    ('pm.MaterialField("J",3)', "bad", ("function",)),
    ('pm.MaterialField("a\\nb",lambda s: s.F)', "bad", ("name",)),
    ('q=loaded()\nq.fields(pm.MaterialField("J",lambda s: s.nothing))', "bad", ("J",)),
    ('q=loaded()\nq.fields(pm.MaterialField("J",lambda s: ufl.as_vector((1,2))))', "bad", ("J",)),
    ('q=loaded()\nq.fields(pm.MaterialField("J",lambda s: np.exp(s.F)))', "bad", ("J",)),
    ('pm.register_basis("mpm")', "bad", ("basis",)),
    ("pm.register_basis(pm.Basis)", "bad", ("basis",)),
    (
        "class B(pm.Basis):\n"
        '    name="b"\n'
        "    degree=1\n"
        "    def lines(self,g,x,c): return np.zeros((len(x),2,2,2))\n"
        "pm.register_basis(B())",
        "bad",
        ("one",),
    ),
    (
        "class B(pm.Basis):\n"
        '    name="b"\n'
        "    degree=1\n"
        "    def lines(self,g,x,c): return None\n"
        "pm.register_basis(B())",
        "bad",
        ("basis",),
    ),
    (
        "class B(pm.Basis):\n"
        '    name="b"\n'
        "    degree=9\n"
        "    def lines(self,g,x,c): return None\n"
        "pm.register_basis(B())",
        "bad",
        ("degree",),
    ),
    (
        "class B(pm.Basis):\n"
        "    name=3\n"
        "    degree=1\n"
        "    def lines(self,g,x,c): return None\n"
        "pm.register_basis(B())",
        "bad",
        ("name",),
    ),
    (
        "class B(pm.Basis):\n    degree=1\n    def lines(self,g,x,c): return None\nprob(basis=B())",
        "bad",
        ("name",),
    ),
    (
        "class B(pm.Basis):\n"
        '    name="b"\n'
        "    degree=1\n"
        "    def lines(self,g,x,c): return 1/0\n"
        "prob(basis=B())",
        "bad",
        ("basis",),
    ),
    (
        "class B(pm.Basis):\n"
        '    name="b"\n'
        "    degree=1\n"
        '    sliver="a"\n'
        "    def lines(self,g,x,c): return None\n"
        "prob(basis=B())",
        "bad",
        ("sliver",),
    ),
    ("pm.Weights(1,2,3)", "bad", ("Weights",)),
    ("pm.Weights(np.zeros((3,2)),np.ones((3,2)),np.zeros((3,2,2,2)))", "bad", ("Weights",)),
    ("pm.Weights(np.zeros((3,2),int),np.full((3,2),5),np.zeros((3,2,2,2)))", "bad", ("Weights",)),
    ("pm.Weights(np.zeros((3,2),int),np.full((3,2),2),np.full((3,2,2,2),np.nan))", "bad", ("Weights",)),
    ('clamped().fix(pm.plane(y=0.0),uy="0")', "bad", ("uy",)),
    ('clamped().fix(pm.plane(y=0.0),uy=lambda t: "a")', "bad", ("uy",)),
    ("clamped().fix(pm.plane(y=0.0),uy=lambda: 0.0)", "bad", ("uy",)),
    ("clamped().fix(pm.plane(y=0.0),uy=lambda a,b,c: 0.0)", "bad", ("uy",)),
    ("clamped().fix(pm.plane(y=0.0),uy=1j)", "bad", ("uy",)),
    ("clamped().fix(pm.plane(y=0.0),uy=np.float32(0))", "ok", ()),
    (
        "q=loaded()\nq.body_load(force=lambda t,X: X.__imul__(0.0))\nrun(q)\nassert q.points.x.max()>0",
        "ok",
        (),
    ),
    ("q=loaded(reset=1)\nrun(q)\nq.points.wryness[:]=np.inf\nrun(q,1,to=2.0)", "bad", ("wryness",)),
    ("q=loaded()\nrun(q)\nq.points.F[:]*=-1\nrun(q,1,to=2.0)", "bad", ("F",)),
    ("q=loaded()\nq.points.F=q.points.F[:-1]\nrun(q)", "bad", ("F",)),
    ("q=loaded()\nq.points.volume0[:]=-1\nrun(q)", "either", ("volume",)),
    ("p=pts()\np.volume0[:]=-1\npm.QuasiStatic(grid(),p)", "bad", ("volume0",)),
    ("p=pts()\np.q=p.q.astype(np.float32)\npm.QuasiStatic(grid(),p)", "bad", ("q",)),
    ("p=pts()\np.x=p.x.tolist()\npm.QuasiStatic(grid(),p)", "bad", ("x",)),
    ("p=pts(2,VM)\np.plastic_F[:]=0\npm.QuasiStatic(grid(),p)", "bad", ("plastic_F",)),
    ("p=pts(2,VM)\np.hardening[:]=np.nan\npm.QuasiStatic(grid(),p)", "bad", ("hardening",)),
    (
        "q=loaded(2,VM,f=3e3,reset=1)\nrun(q)\nq.points.hardening[0]=np.nan\nrun(q,1,to=1.1)",
        "bad",
        ("hardening",),
    ),
    ("pm.plane(x=np.float32(1))", "ok", ()),
    ("pm.plane(x=10**400)", "bad", ("x",)),
    ('pm.plane(x="1")', "bad", ("x",)),
    ("prob().fix(pm.plane(x=1e300),u=0)", "bad", ("plane",)),
    ("pm.plane(x=1,beyond=3)", "bad", ("beyond",)),
    ("pm.plane(x=1,moving=1)", "bad", ("moving",)),
    ("pm.Surface([],[],[])", "bad", ("x",)),
    ("pm.Surface([[0,0,0,0]],[1],[[1,0,0,0]])", "bad", ("x",)),
    ('pm.Surface([[0,0]],["a"],[[1,0]])', "bad", ("area",)),
    ("pm.Surface([[0,0]],[np.inf],[[1,0]])", "bad", ("area",)),
    ("pm.Surface([[0,0]],[1],[[0,0]])", "bad", ("normal",)),
    ("pm.Surface([[0,0]],[1],[[np.nan,0]])", "bad", ("normal",)),
    ("pm.Surface.line((0,0),(1,0),np.int8(3))", "ok", ()),
    ("pm.Surface.line(None,(1,0),3)", "bad", ("a =",)),
    ("pm.Surface.line((0,0),(1,0),10**12)", "bad", ("GiB",)),
    ("pm.Surface.rectangle((0,0,0),(1,0,0),(0,1,0),10**7)", "bad", ("GiB",)),
    ("pm.Surface.rectangle((0,0,0),(1,0,0),(0,1,0),[2,3])", "ok", ()),
    ("pm.Surface.rectangle((0,0,0),(1,0,0),(0,1,0),None)", "bad", ("points",)),
    ("pm.Surface.rectangle((0,0,0),(1e-200,0,0),(0,1,0),2)", "bad", ("edge1",)),
]
